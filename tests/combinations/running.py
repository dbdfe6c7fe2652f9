"""Runs of a scene: by a method, and in one of several ways."""

from __future__ import annotations

from combinations.run import Run

__all__ = ["Run"]
