"""Contacts: geometry, rows, the Delassus system, laws."""
