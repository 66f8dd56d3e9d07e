"""Coordinates that fit a robot: known from what its features are, before any data.

Angles become points on a circle, attitudes tilt and heading, velocities those in the body's frame:
the same state in numbers without jumps. `symmetry` leaves out what shifting and turning the world
changes.
"""

from jbrep.coordinates.coordinates import Coordinates as Coordinates
from jbrep.coordinates.coordinates import Part as Part
from jbrep.coordinates.coordinates import is_torch as is_torch
from jbrep.coordinates.coordinates import library_of as library_of
from jbrep.coordinates.coordinates import wrapped as wrapped
from jbrep.coordinates.made import INGREDIENTS as INGREDIENTS
from jbrep.coordinates.made import OBSERVATION as OBSERVATION
from jbrep.coordinates.made import Ingredient as Ingredient
from jbrep.coordinates.made import System as System
from jbrep.coordinates.made import make_coordinates as make_coordinates
