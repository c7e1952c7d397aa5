"""Attributes of codes: what the regression finds, and what its edits change."""

import pytest
import torch

from recon.garments import load_decoder
from recon.garments.attributes import labels_of, learn_attribute


def test_the_entry_that_tells_is_found_and_the_others_kept():
    g = torch.Generator().manual_seed(0)
    codes = torch.randn(300, 8, generator=g) * torch.tensor([1.0, 2, 1, 1, 5, 1, 1, 1]) + 3
    labels = codes[:, 1] + 0.2 * torch.randn(300, generator=g) > 3
    found = learn_attribute(codes, labels)
    assert found.accuracy > 0.9
    assert (found.way != 0).tolist() == [False, True] + 6 * [False] and found.way[1] > 0
    z = codes[0]
    edited = found.edit(z, 1.0)
    assert edited[1] > z[1] and torch.equal(edited[2:], z[2:])
    torch.testing.assert_close(found.edit(edited, -1.0), z)


def test_labels_come_from_pattern_parameters():
    parameters = [{"sleeve_x": 0.2}, {"sleeve_x": 0.6, "opening": 0.05}, {}, {"sleeve_x": 0.3}]
    rows, long = labels_of(parameters, "sleeves")
    assert rows.tolist() == [0, 1, 3] and long.tolist() == [False, True, False]
    assert labels_of(parameters, "opening")[1].tolist() == [False, True, False, False]


def test_labels_all_alike_are_refused():
    with pytest.raises(ValueError, match="alike"):
        learn_attribute(torch.randn(5, 3), torch.ones(5, dtype=torch.bool))


@pytest.mark.parametrize(("kind", "name"), [("top", "sleeves"), ("trousers", "length")])
def test_learned_codes_tell_sleeves_and_lengths(kind, name):
    decoder = load_decoder(kind)
    rows, labels = labels_of(decoder.parameters, name)
    assert learn_attribute(decoder.codes[rows], labels).accuracy > 0.85
