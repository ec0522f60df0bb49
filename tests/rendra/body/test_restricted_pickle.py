"""Pickles as the authors of body models wrote them are read; hostile ones run nothing and are named."""

import copyreg
import io
import os
import pickle
import struct
import sys
import tracemalloc
import types
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.sparse

from rendra.body.restricted_pickle import ChumpyArray, PickleRefused, SparseMatrix, numbers, read_pickle


def _read(folder: Path, content: bytes) -> Any:
    path = folder / "body.pkl"
    path.write_bytes(content)
    return read_pickle(path)


@contextmanager
def _chumpy() -> Iterator[types.SimpleNamespace]:
    """The package's two classes under its names, while they are pickled."""
    made = {}
    sys.modules["chumpy"] = types.ModuleType("chumpy")
    for module, name in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
        of = type(name, (), {"__init__": lambda self, **state: self.__dict__.update(state), "__module__": module})
        made[name] = of
        sys.modules[module] = types.ModuleType(module)
        setattr(sys.modules[module], name, of)
    try:
        yield types.SimpleNamespace(**made)
    finally:
        for module in ("chumpy", "chumpy.ch", "chumpy.reordering"):
            del sys.modules[module]


class _Python2(pickle._Pickler):  # type: ignore[name-defined, misc]
    """Writes bytes and text as Python 2 wrote its `str`, and its names of modules."""

    dispatch: ClassVar[dict[type, Any]] = dict(pickle._Pickler.dispatch)  # type: ignore[attr-defined]

    def _string(self, value: bytes | str) -> None:
        raw = value if isinstance(value, bytes) else value.encode("latin1")
        if self.proto == 0:
            self.write(b"S" + repr(raw)[1:].encode("ascii") + b"\n")
        else:
            self.write(b"T" + struct.pack("<i", len(raw)) + raw)
        self.memoize(value)

    dispatch[bytes] = dispatch[str] = _string


def _python2(value: Any, protocol: int = 2) -> bytes:
    file = io.BytesIO()
    _Python2(file, protocol, fix_imports=True).dump(value)
    return file.getvalue()


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_python_2_with_chumpy_and_scipy(tmp_path: Path, protocol: int) -> None:
    shapes = np.random.default_rng(0).normal(size=(5, 3, 4))
    regressor = scipy.sparse.random(3, 5, 0.5, "csc", rng=np.random.default_rng(1))
    with _chumpy() as chumpy:
        whole = chumpy.Ch(x=shapes, _dirty_vars={"x"}, _itr=None)
        chosen = chumpy.Select(a=whole, idxs=np.array([0, 7, 59]), preferred_shape=(3, 1))
        content = {
            "shapedirs": whole, "some": chosen, "J_regressor": regressor, "v": np.asfortranarray(shapes[:, :, 0]),
            "bs_style": "lbs", "f": np.arange(6, dtype=np.uint32).reshape(2, 3), "big": np.arange(3, dtype=">f8"),
        }  # fmt: skip
        stream = _python2(content, protocol)
    read = _read(tmp_path, stream)
    assert isinstance(read["shapedirs"], ChumpyArray)
    assert isinstance(read["J_regressor"], SparseMatrix)
    np.testing.assert_array_equal(numbers(read["shapedirs"]), shapes)
    np.testing.assert_array_equal(numbers(read["some"]), shapes.reshape(-1)[[0, 7, 59]].reshape(3, 1))
    np.testing.assert_array_equal(numbers(read["J_regressor"]), regressor.toarray())
    np.testing.assert_array_equal(read["v"], shapes[:, :, 0])
    np.testing.assert_array_equal(read["f"], content["f"])
    np.testing.assert_array_equal(read["big"], np.arange(3.0))
    assert read["bs_style"] == "lbs"


@pytest.mark.parametrize("protocol", range(6))
def test_every_protocol_of_python_3(tmp_path: Path, protocol: int) -> None:
    content = {
        "a": np.arange(12, dtype=np.float32).reshape(3, 4), "fortran": np.asfortranarray(np.eye(3)[:, :2]),
        "empty": np.zeros((0, 3)), "scalar": np.float64(2.5), "bool": np.array([True, False]),
        "text": np.array(["ab", "c"]), "nested": {"list": [1, (2, 3.5, None)], "set": {1, 2}},
        "negative": -(2**40), "none": None, "strided": np.arange(10)[::2],
    }  # fmt: skip
    read = _read(tmp_path, pickle.dumps(content, protocol))
    for key in ("a", "fortran", "empty", "bool", "text", "strided"):
        np.testing.assert_array_equal(read[key], content[key])
    assert read["scalar"] == 2.5
    assert read["nested"]["list"] == [1, (2, 3.5, None)]
    assert sorted(read["nested"]["set"]) == [1, 2]
    assert read["negative"] == -(2**40)


@pytest.mark.parametrize("form", ["csc", "csr", "coo"])
def test_sparse_formats(tmp_path: Path, form: str) -> None:
    for make in (scipy.sparse.random, scipy.sparse.random_array):
        shape = ((4, 4),) if make is scipy.sparse.random_array else (4, 4)
        matrix = make(*shape, density=0.6, format=form, rng=np.random.default_rng(2))
        read = _read(tmp_path, pickle.dumps({"m": matrix}, 2))
        np.testing.assert_array_equal(numbers(read["m"]), matrix.toarray())


def _sparse(**state: Any) -> SparseMatrix:
    matrix = SparseMatrix()
    matrix.__setstate__(state)
    return matrix


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (SparseMatrix(), "without 'shape'"),
        (_sparse(_shape=(10**6, 10**9)), "1,000,000 x 1,000,000,000 numbers"),
        (_sparse(_shape=(2,)), "two sides"),
        (_sparse(_shape=(2, 2), indptr=np.array([0, 10**12, 0]), indices=np.zeros(0, int), data=[]), "do not rise"),
        (_sparse(_shape=(2, 2), indptr=np.array([0, 1]), indices=np.zeros(1, int)), "with 2 pointers"),
        (_sparse(_shape=(2, 2), row=np.array([0]), col=np.array([5]), data=np.ones(1)), "outside its shape"),
        (_sparse(_shape=(2, 2), row=np.array([0]), col=np.array([-1]), data=np.ones(1)), "outside its shape"),
        (_sparse(_shape=(2, 2), row=np.array([0]), col=np.array([1]), data=np.ones(2)), "not equally long"),
        (_sparse(_shape=(2, 2), row=np.array([0.0]), col=np.array([1]), data=np.ones(1)), "row of float64"),
        (ChumpyArray(), "no plain array: it has nothing"),
        ("text", "a str, where an array"),
        (np.array(["a"]), "where numbers are expected"),
    ],
)
def test_what_is_no_array_of_numbers(matrix: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        numbers(matrix)


def test_chumpy_that_holds_itself() -> None:
    loop = ChumpyArray()
    loop.__setstate__({"x": loop})
    with pytest.raises(ValueError, match="no plain array"):
        numbers(loop)


class _Call:
    """Pickles as a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.how = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.how


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def _calls(marker: Path) -> dict[str, bytes]:
    """Streams that would make the marker file, if they were run."""
    touch = f"open({str(marker)!r}, 'w').close()"
    shell = f"touch {marker}"
    return {
        "posix.system": pickle.dumps(_Call(os.system, shell), 4),  # STACK_GLOBAL
        "os.system": b"cos\nsystem\n" + _text(shell) + b"\x85R.",  # GLOBAL
        "os.popen": b"(" + _text(shell) + b"ios\npopen\n.",  # INST
        "builtins.eval": pickle.dumps(_Call(eval, touch), 4),
        "__builtin__.exec": pickle.dumps(_Call(exec, touch), 2),
        "builtins.getattr": b"cbuiltins\ngetattr\n(cnumpy\nndarray\n" + _text("__class__") + b"tR.",
        "numpy.load": pickle.dumps(_Call(np.load, str(marker)), 4),
        "numpy.testing._private.utils.runstring": b"cnumpy.testing._private.utils\nrunstring\n("
        + _text(touch)
        + b"}tR.",
        "numpy.f2py.diagnose.run": b"cnumpy.f2py.diagnose\nrun\n)R.",
        "subprocess.Popen": b"csubprocess\nPopen\n(" + _text(shell) + b"I0\nNNNNNI1\nI1\ntR.",
        "collections.OrderedDict": b"ccollections\nOrderedDict\n)R.",
        "numpy.core.multiarray.fromfile": b"cnumpy.core.multiarray\nfromfile\n" + _text(str(marker)) + b"\x85R.",
        "numpy.ndarray": b"cnumpy\nndarray\n" + b"I1000000000000\n\x85" + _text("b") + b"\x86R.",
        "array of _DType": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\ndtype\nI0\n\x85" + _text("b") + b"tR.",
        "rebuilds _DType": b"ccopy_reg\n_reconstructor\n(cnumpy\ndtype\nc__builtin__\nobject\nNtR.",
        "foreign.Thing": b"ccopy_reg\n_reconstructor\n(cforeign\nThing\nc__builtin__\nobject\nNtR.",
        "encodes as zlib": b"c_codecs\nencode\n(" + _text("a") + _text("zlib") + b"tR.",
        "state of ChumpyArray to a tuple": b"cchumpy.ch\nCh\n)\x81(I1\ntb.",
        "sets attributes of ChumpyArray": b"cchumpy.ch\nCh\n}b.",
        "sets attributes of numpy.core.multiarray._reconstruct": b"cnumpy.core.multiarray\n_reconstruct\n"
        + b"(N}"
        + _text("call")
        + b"Nstb.",
        "sets attributes of list": b"](N}" + _text("x") + b"Nstb.",
        "instruction PERSID": b"Pname\n.",
        "instruction BINPERSID": b"NQ.",
        "instruction EXT1": b"\x82\x01.",
        "instruction EXT4": b"\x84\x01\x00\x00\x00.",
        "instruction FROZENSET": b"(\x91.",
        "makes bytes": b"cbuiltins\nbytes\nI1000000000000\n\x85R.",
        "instruction NEXT_BUFFER": b"\x97.",
        "instruction LONG4": b"\x8b" + struct.pack("<I", 2**31 - 1) + b".",
        "instruction NEWOBJ_EX": b"cchumpy.ch\nCh\n)}\x92.",
        "an array of O8": b"cnumpy\ndtype\n(" + _text("O8") + b"I0\nI1\ntR.",
        "key": b"}(I1\n\x85I2\nu.",
        "sets items of a list": b"](I1\nI2\nu.",
        "makes a _DType": b"cnumpy\ndtype\n)\x81.",
        "a set of what is no list": b"c__builtin__\nset\nI5\n\x85R.",
    }


_HOSTILE = sorted(_calls(Path("marker")))


@pytest.mark.parametrize("what", _HOSTILE)
def test_hostile_pickles_run_nothing(tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = tmp_path / "marker"
    monkeypatch.setitem(copyreg._inverted_registry, 1, ("os", "system"))  # type: ignore[attr-defined]
    monkeypatch.setitem(copyreg._extension_cache, 1, os.system)  # type: ignore[attr-defined]
    modules = set(sys.modules)
    with pytest.raises(PickleRefused) as refusal:
        _read(tmp_path, _calls(marker)[what])
    words = str(refusal.value)
    assert what in words
    assert words.startswith(f"{tmp_path / 'body.pkl'} was not read: ")
    assert "\n" not in words
    assert len(words) < len(str(tmp_path)) + 200
    assert not marker.exists()
    assert set(sys.modules) == modules


def test_the_marker_can_be_made(tmp_path: Path) -> None:
    """The streams above do what they say where they are run."""
    pickle.loads(_calls(tmp_path / "marker")["os.system"])
    assert (tmp_path / "marker").exists()


def _array(shape: bytes, content: bytes, dtype: bytes = b"f8") -> bytes:
    """An array's pickle with any claims."""
    return (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nI0\n\x85" + _text("b") + b"tR(I1\n" + shape
        + b"cnumpy\ndtype\n(" + _text(dtype.decode()) + b"I0\nI1\ntR(I3\n" + _text("<") + b"NNNI-1\nI-1\nI0\ntbI00\n"
        + content + b"tb."
    )  # fmt: skip


def test_claims_of_bytes_are_not_believed(tmp_path: Path) -> None:
    content = b"T" + struct.pack("<i", 16) + bytes(16)
    np.testing.assert_array_equal(_read(tmp_path, _array(b"I2\n\x85", content)), np.zeros(2))
    tracemalloc.start()
    try:
        for stream, words in (
            (_array(b"I1000000000000\n\x85", content), "claims an array of 8,000,000,000,000 bytes and has 16"),
            (_array(b"I99999999999\nI99999999999\n\x86", content), "claims an array of 79,999,"),
            (_array(b"I-1\n\x85", content), "shape is none"),
            (_array(b"I2\n\x85", b"]"), "array of objects"),
            (b"\x8d" + struct.pack("<Q", 2**63 + 1) + b"ab.", None),
            (_array(b"I2\n\x85", b"\x96" + struct.pack("<Q", 2**40) + b"ab"), None),
            (b"T" + struct.pack("<i", -5) + b"ab.", None),
        ):
            with pytest.raises(ValueError if words is None else PickleRefused, match=words or "or cut off"):
                _read(tmp_path, stream)
        assert _read(tmp_path, b"Nr\xff\xff\xff\x7f.") is None  # a memo of two thousand million places
        assert tracemalloc.get_traced_memory()[1] < 3e6
    finally:
        tracemalloc.stop()


def test_the_same_bytes_shown_many_times(tmp_path: Path) -> None:
    """A hundred arrays of one string take no more than the file, or are refused."""
    raw = b"T" + struct.pack("<i", 80_000) + bytes(80_000) + b"q\x01"
    one = _array(b"I10000\n\x85", b"h\x01")[:-1]
    stream = raw + b"0}(" + b"".join(_text(f"k{i}") + one for i in range(100)) + b"u."
    tracemalloc.start()
    try:
        with pytest.raises(PickleRefused, match=r"claims arrays of 8,000,000 bytes and has"):
            _read(tmp_path, stream)
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


def test_too_many_instructions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rendra.body.restricted_pickle._MOST_INSTRUCTIONS", 100)
    with pytest.raises(PickleRefused, match="more than 100 instructions"):
        _read(tmp_path, b"N0" * 100 + b"N.")


def test_deep_nests(tmp_path: Path) -> None:
    _read(tmp_path, b"]" * 100_000 + b"a" * 99_999 + b".")
    with pytest.raises(PickleRefused, match="a tuple for a key"):
        _read(tmp_path, b"}N" + b"\x85" * 50_000 + b"Ns.")


@pytest.mark.parametrize(
    "content",
    [b"", b"\x80", b"not a pickle", b"\x80\x09N.", b"}", b"(", b"N", b"R.", b"h\x05.", b"I1\n)R.", b"\xff."],
)
def test_no_pickles(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(ValueError, match=r"body\.pkl is no pickle, or cut off: ") as error:
        _read(tmp_path, content)
    assert "\n" not in str(error.value)


def test_every_prefix_of_a_pickle_is_refused(tmp_path: Path) -> None:
    stream = pickle.dumps({"a": np.arange(3.0), "m": scipy.sparse.csc_matrix(np.eye(2))}, 2)
    for end in range(len(stream) - 1):
        with pytest.raises((ValueError, PickleRefused)):
            _read(tmp_path, stream[:end])


def test_noise_in_a_pickle_makes_only_the_errors_that_are_named(tmp_path: Path) -> None:
    stream = bytearray(pickle.dumps({"a": np.arange(3.0), "m": scipy.sparse.csc_matrix(np.eye(2))}, 2))
    rng = np.random.default_rng(0)
    for _ in range(400):
        noisy = bytearray(stream)
        for place in rng.integers(0, len(noisy), 2):
            noisy[place] = rng.integers(256)
        with suppress(ValueError, PickleRefused):
            _read(tmp_path, bytes(noisy))


def test_a_file_that_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rendra.body.restricted_pickle._MOST_BYTES", 10)
    with pytest.raises(ValueError, match="has 11 bytes; at most 10 are read"):
        _read(tmp_path, b"N" * 11)
