"""Words of a text scene file, each with its line: what the readers of ``.sc`` and ``.nff`` share."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from workbench.errors import SceneError
from workbench.geometry.polygons import check_polygon, is_convex, vector_area
from workbench.scene.library import polygon_fault

__all__ = ["Words", "read_text", "ring_fault"]

LARGEST = 1e60
"""Largest coordinate that a reader takes: four of them multiplied still fit a double."""

LARGEST_SIDE = 8192
"""Largest picture side in pixels; a picture of that size is computed in 1.6 GB."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\Z")
_INTEGER = re.compile(r"[+-]?[0-9]{1,18}\Z")


def read_text(path: str | Path) -> str:
    """The text of a UTF-8 file.

    Raises
    ------
    SceneError
        If the file cannot be opened or is not UTF-8.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(
            f"cannot be read ({error.strerror or error}); check the name and the permissions", path=path
        ) from None
    except ValueError:
        raise SceneError("is no file name (it holds a NUL character); check the name", path=ascii(path)) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise SceneError(
            f"found the byte 0x{data[error.start]:02x}, expected UTF-8 text; convert the file", path=path, line=line
        ) from None


def _quote(word: str) -> str:
    """A word as it may stand in a one-line message: printable, and not endless."""
    return ascii(word if len(word) <= 40 else word[:37] + "...")


class Words:
    """The words of one file, read from front to back.

    ``#`` starts a comment that ends with the line.  ``line`` is that of the word taken last.
    """

    def __init__(self, text: str, path: str | Path, pattern: str = r"\S+") -> None:
        self.path = Path(path)
        word = re.compile(pattern)
        self._words = [
            (match.group(), number)
            for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1)
            for match in word.finditer(line.split("#", 1)[0])
        ]
        self._next = 0
        self.line = 1

    def fail(self, message: str, line: int | None = None) -> NoReturn:
        """Raise :class:`SceneError` at ``line``, or at the word taken last."""
        raise SceneError(message, path=self.path, line=self.line if line is None else line)

    def peek(self) -> str | None:
        """The next word, left where it is; ``None`` at the end of the file."""
        return self._words[self._next][0] if self._next < len(self._words) else None

    def take(self, wanted: str) -> str:
        """The next word; at the end of the file an error that says what was ``wanted``."""
        if self._next == len(self._words):
            self.fail(f"the file ends where {wanted} was expected")
        word, self.line = self._words[self._next]
        self._next += 1
        return word

    def number(self, wanted: str, low: float = -LARGEST, high: float = LARGEST) -> float:
        """A finite number in ``low..high``."""
        word = self.take(wanted)
        if not _NUMBER.match(word):
            self.fail(f"found {_quote(word)}, expected a number for {wanted}")
        value = float(word)
        if not low <= value <= high:
            self.fail(f"found {_quote(word)} for {wanted}, expected a number from {low:g} to {high:g}")
        return value

    def next_is_number(self) -> bool:
        """Whether the next word is a number."""
        word = self.peek()
        return word is not None and _NUMBER.match(word) is not None

    def integer(self, wanted: str, low: int, high: int) -> int:
        """A whole number in ``low..high``."""
        word = self.take(wanted)
        if not _INTEGER.match(word) or not low <= int(word) <= high:
            self.fail(f"found {_quote(word)} for {wanted}, expected a whole number from {low} to {high}")
        return int(word)

    def numbers(self, count: int, wanted: str, low: float = -LARGEST, high: float = LARGEST) -> NDArray[np.float64]:
        """``count`` numbers as an array."""
        return np.asarray([self.number(f"{wanted} ({i + 1} of {count})", low, high) for i in range(count)])

    def points(self, count: int, columns: int, wanted: str) -> NDArray[np.float64]:
        """``count`` rows of ``columns`` numbers as a ``(count, columns)`` array."""
        # Row by row: a wrong count must end at the wrong word, not at an allocation.
        return np.asarray([self.numbers(columns, f"{wanted} {i + 1}") for i in range(count)])

    def unknown(self, word: str, wanted: str) -> NoReturn:
        """Raise for a keyword that does not exist."""
        self.fail(f"found {_quote(word)}, expected {wanted}")

    def quote(self, word: str) -> str:
        """A word as it may stand in a message."""
        return _quote(word)


def ring_fault(ring: NDArray[np.float64]) -> str | None:
    """What is wrong with a ring (n, 3), in a few words, or ``None``: flat, with an area, not self-crossing.

    The slow tests are kept for rings that are not convex.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        fault = check_polygon([ring])
        if fault is None and len(ring) > 3:
            vector = vector_area(ring)
            if not is_convex(ring, vector / np.linalg.norm(vector)):
                fault = polygon_fault([ring])
    return fault
