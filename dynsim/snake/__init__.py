"""Compiled functions of the kinematic snake, which is no tree of bodies: chain, controller, support, plant, ticks."""
