"""Shared by the garment tests: a decoder trained for a moment on made garments."""

import pytest

from tests.garments.synthetic import family


@pytest.fixture(scope="session")
def tubes():
    """Six made garments; the third and sixth are open in front."""
    return family(6)


@pytest.fixture(scope="session")
def training(tmp_path_factory, tubes):
    """(decoder, state, config) of a short training with small networks."""
    from pipelines.train_isp import TrainIsp, learn

    config = TrainIsp(
        kind="skirt",
        out=tmp_path_factory.mktemp("weights"),
        steps=260,
        threads=1,
        batch=6,
        width=96,
        code=8,
        evaluate=0,
    )
    return *learn(tubes, config), config


@pytest.fixture(scope="session")
def decoder(training):
    """The decoder of that training."""
    return training[0]
