"""Pickles of other programs, read without running them: arrays and plain containers only, everything else is refused.

Body models and pose estimators ship Python pickles, which may name any function to call. Here only NumPy's array
constructors are called for real; SciPy's sparse matrices and chumpy's arrays arrive as inert holders of their state and
are turned into arrays afterwards, so neither chumpy nor a matching SciPy is needed.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from recon.types import UserError


class _Inert:
    """Stands in for an object of another library: takes its state, does nothing with it."""

    def __init__(self, *args: Any) -> None:
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        self.state = dict(state) if isinstance(state, dict) else {}


class _Sparse(_Inert):
    """A SciPy sparse matrix in compressed columns (csc) or rows (csr)."""

    columns = True

    def array(self) -> np.ndarray:
        """The dense (rows, columns) array."""
        import scipy.sparse as sp

        shape = self.state.get("_shape", self.state.get("shape"))
        parts = tuple(np.asarray(self.state[k]) for k in ("data", "indices", "indptr"))
        return (sp.csc_matrix if self.columns else sp.csr_matrix)(parts, shape=shape).toarray()


class _SparseRows(_Sparse):
    columns = False


class _Chumpy(_Inert):
    """A chumpy array: a plain one holds ``x``, a selection ``a`` and the flat indices ``idxs`` into it."""

    def array(self) -> np.ndarray:
        """The value as an array."""
        if "x" in self.state:
            return np.asarray(_plain(self.state["x"]))
        whole, chosen = np.asarray(_plain(self.state["a"])), np.asarray(_plain(self.state["idxs"]))
        picked = whole.ravel()[chosen]
        shape = self.state.get("preferred_shape")
        return picked if shape is None else picked.reshape(tuple(shape))


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """What Python 2's byte strings unpickle through; only the codec that they use."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"codec {encoding}")
    return text.encode("latin1")


_NUMPY = {("numpy", "ndarray"), ("numpy", "dtype")}
_NUMPY |= {(f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")}
_NUMPY |= {(f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")}
_STANDARD = {
    ("collections", "OrderedDict"): OrderedDict,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "object"): object,
    ("builtins", "object"): object,
}


def _reconstructor(kind: type, base: type, state: Any) -> Any:
    """``copyreg._reconstructor`` for inert classes alone."""
    if not (isinstance(kind, type) and issubclass(kind, _Inert)):
        raise pickle.UnpicklingError(f"reconstruct {kind}")
    return kind()


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _NUMPY:
            return super().find_class(module, name)
        if (module, name) in _STANDARD:
            return _STANDARD[module, name]
        if module in ("copy_reg", "copyreg") and name == "_reconstructor":
            return _reconstructor
        if module.split(".")[:2] == ["scipy", "sparse"] and name in ("csc_matrix", "csc_array"):
            return _Sparse
        if module.split(".")[:2] == ["scipy", "sparse"] and name in ("csr_matrix", "csr_array"):
            return _SparseRows
        if (module, name) in {("chumpy.ch", "Ch"), ("chumpy.reordering", "Select"), ("chumpy", "Ch")}:
            return _Chumpy
        raise pickle.UnpicklingError(f"{module}.{name}")


def _plain(value: Any) -> Any:
    """Inert objects resolved into arrays, through containers."""
    if isinstance(value, (_Sparse, _Chumpy)):
        return value.array()
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_plain(v) for v in value]
    if isinstance(value, tuple):
        return tuple(_plain(v) for v in value)
    return value


def read_pickle(path: str | Path) -> Any:
    """The arrays and containers in a pickle (Python 2's or 3's).

    Raises:
        UserError: no such file, not a pickle, or one that wants more than arrays and containers.
    """
    try:
        with open(path, "rb") as file:
            return _plain(_ArrayUnpickler(file, encoding="latin1").load())
    except OSError as error:
        raise UserError(f"{path}: found no readable file ({error.strerror}), wanted a pickle of arrays") from None
    except pickle.UnpicklingError as error:
        what = " ".join(str(error).split())
        raise UserError(f"{path}: found a pickle that asks for {what}, wanted arrays and containers only") from None
    except Exception as error:  # a damaged pickle may fail in any way inside the unpickler
        what = " ".join(f"{type(error).__name__} {error}".split())
        raise UserError(f"{path}: found no whole pickle ({what}), wanted a pickle of arrays") from None
