"""Encoding and decoding of the types in `cpm.asn` in unaligned PER, with asn1tools.

Requires: pip install 'cobevglue[cpm]'
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from cobevglue.messages.object_message import MessageError

__all__ = ["SCHEMA", "decode_type", "encode_type", "has_spare_bytes"]

SCHEMA = Path(__file__).with_name("cpm.asn")
"""The ASN.1 file."""


def encode_type(name: str, value: Any) -> bytes:
    """Encode a value of an ASN.1 type.

    Args:
        name: name of the type.
        value: the value in asn1tools' representation: nested dicts, lists, (name, value) for a choice, and so on.

    Raises:
        MessageError: the value is not valid for the type.
    """
    asn1tools = _asn1tools()
    try:
        data: bytes = _specification().encode(name, value, check_constraints=True)
    except (asn1tools.EncodeError, asn1tools.ConstraintsError) as error:
        raise MessageError(f"{name}: {error}") from None
    return data


def decode_type(name: str, data: bytes) -> Any:
    """Decode a value of the named ASN.1 type. Bytes after the value are ignored.

    Raises:
        MessageError: the bytes do not start with the encoding of a value of the type.
    """
    codec = _specification()
    try:
        return codec.decode(name, data)
    except Exception as error:  # on invalid bytes asn1tools also raises IndexError, KeyError, OverflowError and others
        raise MessageError(f"not a {name}: {type(error).__name__}: {error}") from None


def has_spare_bytes(name: str, data: bytes) -> bool:
    """Return whether further bytes follow the encoded value, which `decode_type` ignores.

    The last byte of an encoding contains at least one bit of the value, so without it decoding fails.
    """
    try:
        decode_type(name, data[:-1])
    except MessageError:
        return False
    return True


@cache
def _specification() -> Any:
    return _asn1tools().compile_files(str(SCHEMA), "uper")


@cache
def _asn1tools() -> Any:
    try:
        import asn1tools
    except ImportError as error:
        raise ModuleNotFoundError(
            f"CPMs need asn1tools: pip install 'cobevglue[cpm]' ({error})", name="asn1tools"
        ) from None
    return asn1tools
