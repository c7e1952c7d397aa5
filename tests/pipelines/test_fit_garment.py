"""Where the fit of a hidden garment begins: what outer garments hide has no say, alike codes begin in their middle."""

from __future__ import annotations

import torch

from pipelines.fit_garment import hidden, middle_first


def test_the_outermost_is_not_hidden():
    assert float(hidden(torch.zeros(0, 8, 8), torch.ones(8, 8), 2).max()) == 0


def test_what_lies_beside_an_outer_mask_counts_for_the_own_mask_alone():
    outer, own = torch.zeros(2, 9, 9), torch.zeros(9, 9)
    outer[0, 4, 4] = outer[1, 4, 5] = 1
    own[2:4, :] = 1
    found = hidden(outer, own, 2)
    assert (found[own > 0.5] == 0).all() and float(found[4, 4]) == 1
    assert float(found[5, 2]) == 1 and float(found[6, 7]) == 1  # two pixels away
    assert float(found[7, 4]) == 0 and float(found[4, 8]) == 0  # three


def test_codes_that_are_alike_begin_with_the_one_in_their_middle():
    codes = torch.tensor([[0.0], [1.0], [5.0], [3.0], [2.6]])
    found, scores = torch.tensor([0, 2, 4, 1, 3]), torch.tensor([0.95, 0.94, 0.93, 0.8, 0.7])
    assert middle_first(codes, found, scores, 0.05).tolist() == [4, 2, 0, 1, 3]
    assert middle_first(codes, found, scores, 0.0).tolist() == found.tolist()
