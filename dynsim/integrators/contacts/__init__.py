"""Contacts of the event-driven integrators: events, modes, impacts."""
