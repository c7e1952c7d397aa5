"""The descent loop: finds minima, keeps the best, survives NaN, stops when done, leaves other parameters alone."""

import torch

from recon.descend import Descent, descend


def test_finds_the_minimum_of_a_quadratic_and_passes_others_through():
    start = {"x": torch.tensor([3.0, -2.0]), "c": torch.tensor(7.0)}
    end = descend(start, {"x": 0.2}, lambda v: v["x"].square().sum() + 0 * v["c"], Descent(steps=300, patience=300))
    assert end.values["x"].abs().max() < 1e-2
    assert end.values["c"] == 7 and not end.values["c"].requires_grad


def test_keeps_the_best_seen():
    losses = iter([5.0, 1.0, 3.0, 4.0])
    seen = []

    def loss(v):
        seen.append(v["x"].detach().clone())
        return v["x"].sum() * 0 + next(losses)

    end = descend({"x": torch.zeros(1)}, {"x": 1.0}, loss, Descent(steps=4))
    assert end.loss == 1.0 and torch.equal(end.values["x"], seen[1])


def test_nan_goes_back_to_the_best_and_ends():
    calls = []

    def loss(v):
        calls.append(1)
        return v["x"].square().sum() if len(calls) < 3 else v["x"].sum() * float("nan")

    end = descend({"x": torch.ones(1)}, {"x": 0.1}, loss, Descent(steps=50))
    assert len(calls) == 7 and torch.isfinite(end.values["x"]).all() and end.loss < 1


def test_always_nan_returns_the_start():
    end = descend({"x": torch.ones(2)}, {"x": 0.1}, lambda v: v["x"].sum() * float("nan"), Descent())
    assert end.loss == float("inf") and torch.equal(end.values["x"], torch.ones(2))


def test_stops_on_convergence():
    steps = []
    settings = Descent(steps=500, patience=5)
    descend({"x": torch.zeros(1)}, {"x": 0.1}, lambda v: 1 + 0 * v["x"].sum(), settings, lambda s, _: steps.append(s))
    assert len(steps) <= 7
