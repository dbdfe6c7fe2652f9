"""Scenarios driven in real time from a browser: a server for this machine alone, one pilot, others watch.

browser ─ wishes at 50 Hz ─▶ Server ─▶ Helm ─ an order at each tick ─▶ Driven ─ frames ─▶ Server ─▶ browsers
"""
