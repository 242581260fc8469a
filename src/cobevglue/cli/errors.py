"""Expected errors, reported as one line without a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["InputError", "expected_errors"]


class InputError(Exception):
    """Bad input, or a file that cannot be read or written: reported as one line, exit code 2."""


@contextmanager
def expected_errors() -> Iterator[None]:
    """Convert ValueError (bad input to the API) and OSError to `InputError`.

    For code that depends on the user's input. Elsewhere a ValueError is a bug and is shown with its traceback.
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
