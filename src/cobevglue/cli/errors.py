"""What may go wrong by no fault of the program, as one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["InputError", "expected_errors"]


class InputError(Exception):
    """Bad input or a file that cannot be read or written: one line that says what and where, exit code 2."""


@contextmanager
def expected_errors() -> Iterator[None]:
    """Around what depends on the user's input: the API refuses bad input with ValueError, the system with OSError.

    Only these become an `InputError`; and only here: elsewhere a ValueError is a bug, and shows its traceback.
    """
    try:
        yield
    except OSError as error:
        known = error.strerror and error.filename is not None
        raise InputError(f"{error.filename}: {error.strerror}" if known else _one_line(error)) from error
    except ValueError as error:
        raise InputError(_one_line(error)) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
