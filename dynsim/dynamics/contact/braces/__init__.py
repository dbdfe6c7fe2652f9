"""Statics of braces: forces that hold a posture at least cost."""
