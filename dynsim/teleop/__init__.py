"""Teleoperation: sessions in which a pilot drives an arm or a snake robot, and the web server for the pilot."""
