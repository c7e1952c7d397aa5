"""The renderer's backend: what the doctor says, and what a user is told who lacks LLVM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from recon.render import backend
from recon.types import UserError


def test_report_names_versions_and_works() -> None:
    report = backend.llvm_report()
    assert report.works and not report.advice
    assert "mitsuba" in report.version and "drjit" in report.version and Path(report.path).exists()


def test_missing_library_is_one_line_of_advice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so"))
    with pytest.raises(UserError, match="does not exist; wanted libLLVM") as error:
        backend.load("cpu")
    assert "\n" not in str(error.value)
    report = backend.llvm_report()
    assert not report.works and "pip install" in report.advice


def test_arrays_travel_both_ways() -> None:
    mi, _ = backend.load("cpu")
    values = torch.tensor([1.5, -2.0, 3.25])
    assert torch.equal(backend.to_torch(backend.to_dr(mi.Float, values), values.device), values)
    whole = torch.tensor([7, 0, 2**31 - 1], dtype=torch.int32)
    assert torch.equal(backend.to_torch(backend.to_dr(mi.UInt32, whole), whole.device), whole)
    assert np.asarray(backend.to_dr(mi.Float, values)).dtype == np.float32
