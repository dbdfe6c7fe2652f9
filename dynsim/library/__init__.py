"""Types that a scenario can select with `type`: plants, motors, surfaces, controllers and paths."""
