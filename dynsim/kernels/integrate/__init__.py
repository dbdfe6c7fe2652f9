"""Time integration: methods, error control, projection, dense output, samples, and the driver of it all."""
