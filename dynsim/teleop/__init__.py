"""Teleoperation: sessions of the arm and the snake, and the web page that commands them."""
