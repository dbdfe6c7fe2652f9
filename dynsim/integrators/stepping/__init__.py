"""Time stepping with fixed steps: contacts, compliant rows, drives, ledger and discretisation energy."""
