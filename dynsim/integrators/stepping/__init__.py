"""Time stepping: contacts and limits of drives within fixed steps."""
