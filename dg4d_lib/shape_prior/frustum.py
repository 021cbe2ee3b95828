"""Grid of rays and depths in front of the input camera, on which the shape prior speaks."""

import math

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS

SIZE = 128  # pixels of a side, one ray each
BINS = 64  # depths along a ray
HALF_DEPTH = 0.85  # world units before and behind the plane z = 0
NEAR = RADIUS - HALF_DEPTH  # distance from the camera's plane, world units
FAR = RADIUS + HALF_DEPTH
KNOTS = 8  # depths at which hidden colors are predicted; linear between them
TAN_HALF_FOV = math.tan(math.radians(FOV_Y_DEG) / 2)
