"""Teleoperation: sessions of arms and snake robots, and the web server for a pilot."""
