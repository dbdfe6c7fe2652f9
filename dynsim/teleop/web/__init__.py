"""Scenarios driven in real time from a browser: a server for this machine alone, one pilot, others watch.

browser ─ PilotCommand at 50 Hz ─▶ Server ─▶ Deadman ─ a Command at each tick ─▶ Session ─ frames ─▶ Server ─▶ browsers
"""
