"""Parametric bodies behind one 24-joint rig."""
