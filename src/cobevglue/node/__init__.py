"""A live agent: sends its object lists, receives the others', and publishes alignments and fused objects.

`NodeCore` is all of it without a network; `cobevglue.node.live` connects it by zenoh (pip install 'cobevglue[live]').
"""

from cobevglue.node.core import NodeCore, NodeResult, NodeSettings, Outgoing, warm_up
from cobevglue.node.metrics import Metrics
from cobevglue.node.metrics_server import MetricsPage
from cobevglue.node.own_list import OwnList, parse_list, write_list
from cobevglue.node.session_header import SessionHeader, decode_header, encode_header, new_session

__all__ = [
    "Metrics",
    "MetricsPage",
    "NodeCore",
    "NodeResult",
    "NodeSettings",
    "Outgoing",
    "OwnList",
    "SessionHeader",
    "decode_header",
    "encode_header",
    "new_session",
    "parse_list",
    "warm_up",
    "write_list",
]
