"""Compiled functions of the kinematic snake: chain, controller, support, plant, ticks."""
