"""Teleoperation: sessions of arm and snake, and the web server by which a pilot commands them."""
