"""What all settings share: frozen, in range, and an unknown name is an error that says what was probably meant."""

from __future__ import annotations

import difflib
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator

__all__ = ["Settings"]


class Settings(BaseModel):
    """Base of all settings.

    Raises:
        ValueError: a value out of its range, or an unknown name; the message has the nearest valid one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _name_the_nearest(cls, values: Any) -> Any:
        for name in values if isinstance(values, dict) else ():
            if name not in cls.model_fields:
                near = difflib.get_close_matches(str(name), cls.model_fields, n=1, cutoff=0.0)
                raise ValueError(f"{cls.__name__} has no setting {str(name)!r}; did you mean {near[0]!r}?")
        return values
