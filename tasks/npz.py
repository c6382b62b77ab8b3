"""Arrays of an .npz file: each is checked against what it must be before a byte of it is read, and none is ever a pickle.

The one reader of that format, for recordings, bundles and dumps; it needs NumPy alone.
"""

import io
import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Literal, overload

import numpy as np

BROKEN = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError, EOFError, ValueError, NotImplementedError,
    RuntimeError, OSError, KeyError, IndexError, MemoryError, OverflowError, SyntaxError, TypeError,
)
"""Whatever zipfile and NumPy raise on a file that is damaged, encrypted, packed in an unknown way, or lies about its sizes."""
LARGEST_HEADER = 1 << 14
"""[bytes] of an array's header; NumPy parses it as Python, whose parser is not to be fed more."""


class ArrayError(ValueError):
    """A file that does not hold the array that was asked for.

    Attributes:
        key: of the array; empty where it is the file.
        expected, found: in a few words.
    """

    def __init__(self, key: str, expected: str, found: str) -> None:
        super().__init__(f"{key + ': ' if key else ''}expected {expected}, found {found}")
        self.key, self.expected, self.found = key, expected, found


class Arrays:
    """An open .npz file.

    Args:
        source: the file, or its content.

    Raises:
        ArrayError: it is no whole .npz file.
    """

    def __init__(self, source: Path | bytes) -> None:
        if isinstance(source, Path) and not source.is_file():
            raise ArrayError("", "a file", "none")
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source)
            self._members = set(self._zip.namelist())
        except BROKEN as error:
            raise _damaged("", error) from None

    def __enter__(self) -> "Arrays":
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    @overload
    def read(
        self, key: str, shape: Sequence[int | None], types: Sequence[str], largest: int = ..., content: Literal[True] = ...,
        finite: bool = ...,
    ) -> np.ndarray: ...

    @overload
    def read(
        self, key: str, shape: Sequence[int | None], types: Sequence[str], largest: int = ..., *, content: Literal[False],
        finite: bool = ...,
    ) -> None: ...

    def read(
        self, key: str, shape: Sequence[int | None], types: Sequence[str], largest: int = 1 << 28, content: bool = True,
        finite: bool = True,
    ) -> np.ndarray | None:
        """An array of this shape and one of these types, numbers as float64.

        Args:
            key: its name.
            shape: None where any length is right.
            types: names of dtypes; "str" is text.
            largest: [bytes] that it may take.
            content: False: look at its header only, and return None.
            finite: whether all numbers must be.

        Raises:
            ArrayError: it is missing, of another shape or type, too large, damaged, or holds numbers that are not finite.
        """
        if f"{key}.npy" not in self._members:
            known = ", ".join(sorted(member.removesuffix(".npy")[:30] for member in self._members)[:8]) or "nothing"
            raise ArrayError(key, "this key", f"only {known}")
        try:
            with self._zip.open(f"{key}.npy") as stream:
                found, fortran, dtype = _header(stream)
                size = _checked(key, tuple(shape), types, largest, found, dtype)
                if not content:
                    return None
                data = stream.read(size)
                # The end of the member is where its checksum is compared.
                if len(data) != size or stream.read(1):
                    raise EOFError("its data are shorter or longer than its header says")
        except ArrayError:
            raise
        except BROKEN as error:
            raise _damaged(key, error) from None
        array = np.frombuffer(data, dtype, count=int(np.prod(found))).reshape(found, order="F" if fortran else "C")
        if dtype.kind == "U":
            return array
        array = array.astype(np.float64)
        if finite and not np.isfinite(array).all():
            where = np.argwhere(~np.isfinite(array))[0].tolist()
            raise ArrayError(key, "finite numbers", f"{array[tuple(where)]} at {where}")
        return array


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"a header of version {version}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(stream, max_header_size=LARGEST_HEADER)


def _checked(
    key: str, shape: tuple[int | None, ...], types: Sequence[str], largest: int, found: tuple[int, ...], dtype: np.dtype
) -> int:
    """[bytes] of an array's data, once its header is what it must be; in Python's integers, which do not overflow."""
    name = "str" if dtype.kind == "U" else dtype.name
    if dtype.hasobject or name not in types:
        raise ArrayError(key, f"dtype {' or '.join(types)}", str(dtype)[:40])
    if len(found) != len(shape) or any(wanted not in (None, length) or length < 0 for wanted, length in zip(shape, found, strict=True)):
        raise ArrayError(key, f"shape ({', '.join('any' if n is None else str(n) for n in shape)})", f"{found}"[:80])
    size = dtype.itemsize
    for length in found:
        size *= int(length)
    if size > largest:
        raise ArrayError(key, f"at most {largest} bytes", f"{size}"[:40])
    return size


def _damaged(key: str, error: BaseException) -> ArrayError:
    why = str(error).split("\n")[0][:80] or type(error).__name__
    return ArrayError(key, "a whole .npz file", f"one that is truncated or damaged ({why})")
