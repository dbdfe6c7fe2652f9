"""Types that a scenario selects with `type`: plants, motors, surfaces, controllers, paths."""
