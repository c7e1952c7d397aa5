"""Drapers: a rest-pose garment onto a posed body."""
