"""Drives of joints: DC motor, position servo, open-loop torque."""
