"""What travels between agents: the object message in bytes, its size, and the object list as a JSON file."""

from cobevglue.messages.object_list import from_dict, read_object_list, to_dict, write_object_list
from cobevglue.messages.object_message import (
    BYTES_PER_OBJECT,
    MAX_AGENT_ID_BYTES,
    MAX_OBJECTS,
    MAX_TRACK_ID,
    VERSION,
    MessageError,
    ObjectMessage,
    decode,
    encode,
    encoded_size,
)

__all__ = [
    "BYTES_PER_OBJECT",
    "MAX_AGENT_ID_BYTES",
    "MAX_OBJECTS",
    "MAX_TRACK_ID",
    "VERSION",
    "MessageError",
    "ObjectMessage",
    "decode",
    "encode",
    "encoded_size",
    "from_dict",
    "read_object_list",
    "to_dict",
    "write_object_list",
]
