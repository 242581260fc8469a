"""Pictures seen from above, and pages of them (`report_page`, `study_report`). Imports matplotlib, but not pyplot."""

from cobevglue.visualization.alignment import draw_alignment
from cobevglue.visualization.bev import draw_agent, draw_boxes, draw_object_graph, draw_pairs
from cobevglue.visualization.detections import draw_detections, draw_points
from cobevglue.visualization.style import EGO, MATCH, OTHER, TRUTH, add_axes, new_figure, save_figure, style_bev

__all__ = [
    "EGO",
    "MATCH",
    "OTHER",
    "TRUTH",
    "add_axes",
    "draw_agent",
    "draw_alignment",
    "draw_boxes",
    "draw_detections",
    "draw_object_graph",
    "draw_pairs",
    "draw_points",
    "new_figure",
    "save_figure",
    "style_bev",
]
