"""Synthetic scenes with exact truth; so far a junction as the object lists that several agents would detect."""

from cobevglue.simulation.object_lists import AgentView, Junction, JunctionSettings, ObjectListFrame

__all__ = ["AgentView", "Junction", "JunctionSettings", "ObjectListFrame"]
