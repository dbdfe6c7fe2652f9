"""Types that a scenario chooses by name: plants, motors, surfaces, controllers, paths."""
