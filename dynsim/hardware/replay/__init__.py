"""A record becomes the motion of servos, and their measured motion a record: check, verify, replay, compare."""
