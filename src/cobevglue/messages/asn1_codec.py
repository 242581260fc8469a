"""Encoding and decoding of the types in an ASN.1 file, unaligned PER, by asn1tools.

Needs: pip install 'cobevglue[cpm]'
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cobevglue.messages.object_message import MessageError

__all__ = ["CPM", "SDSM", "Codec"]


@dataclass(frozen=True)
class Codec:
    """The types of one ASN.1 file.

    Attributes:
        path: of the file.
    """

    path: Path

    def encode(self, name: str, value: Any) -> bytes:
        """Encode a value of the type of this name.

        Args:
            name: of the type.
            value: nested dicts, lists, (name, value) for a choice, and so on, as asn1tools takes them.

        Raises:
            MessageError: the value is not one of the type.
        """
        asn1tools = _asn1tools()
        try:
            data: bytes = _specification(self.path).encode(name, value, check_constraints=True)
        except (asn1tools.EncodeError, asn1tools.ConstraintsError) as error:
            raise MessageError(f"{name}: {error}") from None
        return data

    def decode(self, name: str, data: bytes) -> Any:
        """Decode a value of the type of this name; bytes behind it are ignored.

        Raises:
            MessageError: the bytes do not start with the encoding of a value of the type, or a number is beyond
                its limits (the bits of some types can hold such numbers).
        """
        specification = _specification(self.path)
        try:
            return specification.decode(name, data, check_constraints=True)
        except Exception as error:  # asn1tools lets errors of its own code through: IndexError, KeyError, OverflowError
            raise MessageError(f"not a {name}: {type(error).__name__}: {error}") from None

    def has_spare_bytes(self, name: str, data: bytes) -> bool:
        """Whether bytes follow the encoding of a value of this type, which `decode` accepts.

        The last byte of an encoding holds at least one bit of it, so without that byte it cannot be decoded.
        """
        try:
            self.decode(name, data[:-1])
        except MessageError:
            return False
        return True


CPM = Codec(Path(__file__).with_name("cpm.asn"))
"""ETSI's types."""
SDSM = Codec(Path(__file__).with_name("sdsm.asn"))
"""SAE's types."""


@cache
def _specification(path: Path) -> Any:
    return _asn1tools().compile_files(str(path), "uper")


@cache
def _asn1tools() -> Any:
    try:
        import asn1tools
    except ImportError as error:
        raise ModuleNotFoundError(
            f"CPMs and SDSMs need asn1tools: pip install 'cobevglue[cpm]' ({error})", name="asn1tools"
        ) from None
    return asn1tools
