"""Texts for people: foreign text made printable, and counted nouns."""

from __future__ import annotations

__all__ = ["counter_text", "number_of", "one_line"]
"""Names for packages beside the core."""

MOST_MESSAGE = 1_000
"""Characters of a message: paths and values from files are of any length."""


def one_line(text: str) -> str:
    """A text in one printable line of bounded length; of a longer one the middle is left out.

    Messages quote files, devices and instruments. Their control characters would drive the user's terminal.
    """
    return _shorten(printable(" ".join(_shorten(text).split())))


def _shorten(text: str) -> str:
    end = MOST_MESSAGE // 3
    return text if len(text) <= MOST_MESSAGE else f"{text[: MOST_MESSAGE - end - 5]} ... {text[-end:]}"


def printable(text: str) -> str:
    """The text with control characters, line ends excepted, as escape sequences of Python."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    escaped = ((char, char.encode("unicode_escape").decode("ascii")) for char in text)
    return "".join(char if char.isprintable() or char == "\n" else escape for char, escape in escaped)


def error_text(error: BaseException) -> str:
    """Type and text of an error of foreign code, whose text may itself raise."""
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 - foreign code raises what it likes
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def number_of(n: int, one: str, several: str = "", *, form: str = "") -> str:
    """A count with its noun: ``1 false alarm``, ``2 false alarms``.

    :param several: the plural, where it is not ``one`` and an s.
    :param form: format of the number, such as ``,``.
    """
    return f"{n:{form}} {one if n == 1 else several or f'{one}s'}"


def counter_text(n: int, name: str) -> str:
    """A counter with its value: ``12 frames foreign``, ``1 error frame`` of frames_foreign and error_frames."""
    words = name.split("_")
    if n == 1:
        noun = next((i for i, word in enumerate(words) if word.endswith("s") and not word.endswith(("ss", "us"))), None)
        if noun is not None:
            words[noun] = words[noun].removesuffix("es" if words[noun].endswith(("shes", "sses")) else "s")
    return f"{n} {' '.join(words)}"
