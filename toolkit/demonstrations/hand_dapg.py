"""hand_dapg's demonstrations (Rajeswaran et al., RSS 2018), which are pickles, read without running what is in them.

A pickle is a program for a small stack machine. Python's own reader calls whatever function the program names; this one never calls any: it
goes through the program's instructions (pickletools lists them), knows only those that lists, dictionaries, numbers and text need, and
takes a call of NumPy's for an array as a note of what bytes the array has. Anything else is refused.
"""

import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tasks.task import Task
from toolkit.demonstrations.recorded import LARGEST, Recorded, joined
from toolkit.errors import ToolkitError

NUMBERS = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")
"""Types of an array, as NumPy spells them in a pickle."""
ENCODING = "latin-1"
"""By which Python 2 wrote bytes as text, and Python 3 still does for old protocols."""


class _Refused(ValueError):
    """Why a program is not run."""


@dataclass(frozen=True)
class _Name:
    """A function that the program names."""

    name: str


@dataclass(eq=False)
class _Type:
    """An array's type, once it is known to be one of NUMBERS."""

    code: str
    order: str = "<"


@dataclass(eq=False)
class _Array:
    """An array that is called for and gets its bytes later."""

    array: np.ndarray | None = None


class _Mark:
    """A place on the stack."""


def _text(said: Any) -> Any:
    return said.decode(ENCODING) if isinstance(said, bytes) else said


def _number_type(code: Any, *_: Any) -> _Type:
    code = _text(code)
    if code not in NUMBERS:
        raise _Refused(f"an array of type {str(code)[:20]!r}")
    return _Type(code)


def _array_of(content: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    """An array, of bytes that are as many as its shape asks for."""
    content = content.encode(ENCODING) if isinstance(content, str) else content
    if not isinstance(kind, _Type) or not isinstance(content, bytes | bytearray) or not isinstance(shape, tuple):
        raise _Refused("an array that is no array")
    if not all(isinstance(size, int) and size >= 0 for size in shape):
        raise _Refused(f"an array of shape {str(shape)[:40]}")
    flat = np.frombuffer(bytes(content), np.dtype(kind.order + kind.code))
    size = 1
    for length in shape:
        size *= length
    if size != flat.size:
        raise _Refused(f"an array of shape {str(shape)[:40]} with {flat.size} numbers")
    return flat.reshape(shape, order=order)


def _scalar(kind: Any, content: Any) -> float:
    return float(_array_of(content, kind, (), "C"))


def _text_as_bytes(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise _Refused("bytes in an unknown encoding")
    return text.encode(ENCODING)


CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _number_type,
    "numpy.multiarray._reconstruct": lambda *_: _Array(),
    "numpy.multiarray.scalar": _scalar,
    "numpy.numeric._frombuffer": lambda content, kind, shape, order: _Array(_array_of(content, kind, shape, order)),
    "_codecs.encode": _text_as_bytes,
}
"""What stands in for the functions that a pickle of arrays calls; none is the function itself."""
ARGUMENTS = ("numpy.ndarray",)
"""What such a pickle only names."""


def _global(module: Any, name: Any) -> _Name:
    # NumPy 2 moved numpy.core to numpy._core.
    full = f"{module}.{name}".replace("numpy.core.", "numpy.").replace("numpy._core.", "numpy.")
    if full not in CALLS and full not in ARGUMENTS:
        raise _Refused(f"a call of {f'{module}.{name}'[:60]}")
    return _Name(full)


class _Machine:
    """The stack machine, with the instructions that are known."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, content: bytes) -> Any:
        """What the program leaves."""
        for opcode, argument, _ in pickletools.genops(content):
            if opcode.name == "STOP":
                return self.stack.pop()
            if opcode.name in _CONSTANTS:
                self.stack.append(_CONSTANTS[opcode.name])
            elif opcode.name in _LITERALS:
                self.stack.append(argument)
            elif opcode.name in _STEPS:
                _STEPS[opcode.name](self, argument)
            elif opcode.name not in ("PROTO", "FRAME"):
                raise _Refused(f"an instruction {opcode.name}")
        raise EOFError

    def _since_mark(self) -> list[Any]:
        at = max(i for i, item in enumerate(self.stack) if isinstance(item, _Mark))
        found = self.stack[at + 1 :]
        del self.stack[at:]
        return found

    def _take(self, count: int) -> list[Any]:
        if len(self.stack) < count:
            raise IndexError
        found = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return found

    def mark(self, _: Any) -> None:
        """MARK."""
        self.stack.append(_Mark())

    def new_list(self, _: Any) -> None:
        """EMPTY_LIST; LIST takes what lies above the mark."""
        self.stack.append([])

    def list_of(self, _: Any) -> None:
        """LIST."""
        self.stack.append(self._since_mark())

    def tuple_of(self, _: Any) -> None:
        """TUPLE."""
        self.stack.append(tuple(self._since_mark()))

    def append(self, _: Any) -> None:
        """APPEND."""
        (item,) = self._take(1)
        self._extend([item])

    def appends(self, _: Any) -> None:
        """APPENDS."""
        self._extend(self._since_mark())

    def _extend(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is not list:
            raise _Refused("something that grows and is no list")
        self.stack[-1].extend(items)

    def new_dict(self, _: Any) -> None:
        """EMPTY_DICT."""
        self.stack.append({})

    def dict_of(self, _: Any) -> None:
        """DICT."""
        items = self._since_mark()
        self.stack.append({})
        self._update(items)

    def set_item(self, _: Any) -> None:
        """SETITEM."""
        self._update(self._take(2))

    def set_items(self, _: Any) -> None:
        """SETITEMS."""
        self._update(self._since_mark())

    def _update(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is not dict or not all(isinstance(key, str | bytes) for key in items[::2]):
            raise _Refused("a dictionary whose keys are no text")
        self.stack[-1].update(zip(items[::2], items[1::2], strict=True))

    def keep(self, index: int) -> None:
        """PUT and its kin."""
        self.memo[index] = self.stack[-1]

    def memoize(self, _: Any) -> None:
        """MEMOIZE."""
        self.memo[len(self.memo)] = self.stack[-1]

    def get(self, index: int) -> None:
        """GET and its kin."""
        self.stack.append(self.memo[index])

    def pop(self, _: Any) -> None:
        """POP."""
        self._take(1)

    def named(self, argument: str) -> None:
        """GLOBAL."""
        self.stack.append(_global(*argument.split(" ", 1)))

    def named_on_stack(self, _: Any) -> None:
        """STACK_GLOBAL."""
        self.stack.append(_global(*self._take(2)))

    def call(self, _: Any) -> None:
        """REDUCE: of what stands in for the function."""
        function, arguments = self._take(2)
        if not isinstance(function, _Name) or function.name not in CALLS or not isinstance(arguments, tuple):
            raise _Refused("a call of what is no function")
        self.stack.append(CALLS[function.name](*arguments))

    def build(self, _: Any) -> None:
        """BUILD: an array gets its shape, type and bytes, and a type its byte order."""
        (state,) = self._take(1)
        target = self.stack[-1]
        if not isinstance(state, tuple):
            raise _Refused("an object's inside")
        if isinstance(target, _Array) and len(state) == 5:
            _, shape, kind, fortran, content = state
            target.array = _array_of(content, kind, shape, "F" if fortran else "C")
        elif isinstance(target, _Type) and len(state) > 1:
            order = _text(state[1])
            if order not in ("<", ">", "|", "="):
                raise _Refused("numbers of an unknown byte order")
            target.order = order
        else:
            raise _Refused("an object's inside")


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING", "SHORT_BINSTRING",
    "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
}
_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine.mark, "EMPTY_LIST": _Machine.new_list, "LIST": _Machine.list_of, "TUPLE": _Machine.tuple_of,
    "TUPLE1": lambda machine, _: machine.stack.append(tuple(machine._take(1))),
    "TUPLE2": lambda machine, _: machine.stack.append(tuple(machine._take(2))),
    "TUPLE3": lambda machine, _: machine.stack.append(tuple(machine._take(3))),
    "APPEND": _Machine.append, "APPENDS": _Machine.appends, "EMPTY_DICT": _Machine.new_dict, "DICT": _Machine.dict_of,
    "SETITEM": _Machine.set_item, "SETITEMS": _Machine.set_items, "PUT": _Machine.keep, "BINPUT": _Machine.keep,
    "LONG_BINPUT": _Machine.keep, "MEMOIZE": _Machine.memoize, "GET": _Machine.get, "BINGET": _Machine.get, "LONG_BINGET": _Machine.get,
    "POP": _Machine.pop, "GLOBAL": _Machine.named, "STACK_GLOBAL": _Machine.named_on_stack, "REDUCE": _Machine.call,
    "BUILD": _Machine.build,
}
_DAMAGED = (EOFError, ValueError, IndexError, KeyError, TypeError, UnicodeError, OverflowError, MemoryError, AttributeError)


def read_hand_dapg(path: Path, task: Task) -> Recorded:
    """Read a file of hand_dapg's layout: a list of dictionaries with ``observations`` (T, n_obs) and ``actions`` (T, n_act).

    Their observations and actions are those of gymnasium-robotics, number for number. What else they hold (rewards, start states) is left.

    Raises:
        ToolkitError: it is missing, damaged, a pickle of anything but lists and dictionaries of arrays, of another task's layout, or holds
            numbers that are not finite.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise ToolkitError(f"{path} has {path.stat().st_size} bytes; at most {LARGEST} are read")
        found = _Machine().run(path.read_bytes())
    except OSError as error:
        raise ToolkitError(f"{path} cannot be read ({error.strerror}); give a file of demonstrations") from None
    except _Refused as error:
        raise ToolkitError(f"{path} is a pickle with {error}, which could run code when it is loaded; only lists and dictionaries of "
                           "arrays are read") from None
    except _DAMAGED as error:
        why = str(error).split("\n")[0][:80] or type(error).__name__
        raise ToolkitError(f"{path} is neither an .npz file nor a whole pickle ({why}); fetch it again, or write it as "
                           "docs/demonstrations.md says") from None
    return joined(path, task, _episodes(path, found))


def _episodes(path: Path, found: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    out = []
    for k, episode in enumerate(found if isinstance(found, list) else [None]):
        fields = {_text(key): value for key, value in episode.items()} if isinstance(episode, dict) else {}
        pair = [field.array for key in ("observations", "actions")
                if isinstance(field := fields.get(key), _Array) and field.array is not None]
        if len(pair) < 2:
            raise ToolkitError(f"{path}: its episode {k} has no arrays 'observations' and 'actions'; give one of hand_dapg's files")
        out.append((pair[0], pair[1]))
    return out
