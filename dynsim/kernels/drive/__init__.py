"""What drives the joints: motors with circuits, position servos, open torques."""
