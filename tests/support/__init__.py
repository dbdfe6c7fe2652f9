"""What tests and documented studies of faults share."""
