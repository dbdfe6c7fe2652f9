"""Driving by hand: the arm, the snake, and the web page that drives them."""
