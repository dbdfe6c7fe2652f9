"""Teleoperation through the web: a server on this machine, a pilot in a browser, and spectators in other browsers.

browser ─ PilotCommand at 50 Hz ─▶ Server ─▶ Deadman ─ Command at each tick ─▶ Session ─ frames ─▶ Server ─▶ browsers
"""
