"""Contact problems: forces within friction cones, and cone programs."""
