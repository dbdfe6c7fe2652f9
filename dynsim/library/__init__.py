"""What a scenario names by type: plants, motors, surfaces, controllers, paths."""
