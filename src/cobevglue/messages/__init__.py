"""Messages between agents: object messages and array messages as bytes, and object lists as JSON files.

`cobevglue.messages.cpm` is ETSI's Collective Perception Message in place of the object message,
`cobevglue.messages.sdsm` is SAE's Sensor Data Sharing Message.
"""

from cobevglue.messages.array_message import Arrays, decode_arrays, encode_arrays
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
    "Arrays",
    "MessageError",
    "ObjectMessage",
    "decode",
    "decode_arrays",
    "encode",
    "encode_arrays",
    "encoded_size",
    "from_dict",
    "read_object_list",
    "to_dict",
    "write_object_list",
]
