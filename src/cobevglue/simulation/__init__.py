"""Synthetic scenes with exact ground truth; exported here: a junction with the object lists of several agents."""

from cobevglue.simulation.object_lists import AgentView, Junction, JunctionSettings, ObjectListFrame

__all__ = ["AgentView", "Junction", "JunctionSettings", "ObjectListFrame"]
