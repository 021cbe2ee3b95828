"""Families of synthetic creatures and things, and how often each is sampled."""

from collections.abc import Callable

from training.shape_prior.chance import Chance
from training.shape_prior.families import bipeds, flyers, quadrupeds, things
from training.shape_prior.solids import Shape

Family = Callable[[Chance, Shape], None]

# name: recipe, weight, style of the palette
FAMILIES: dict[str, tuple[Family, float, str]] = {
    "mammal": (quadrupeds.mammal, 0.20, "animal"),
    "lizard": (quadrupeds.lizard, 0.06, "animal"),
    "dinosaur": (quadrupeds.dinosaur, 0.05, "animal"),
    "person": (bipeds.person, 0.22, "cloth"),
    "robot": (bipeds.robot, 0.09, "thing"),
    "bird": (flyers.bird, 0.065, "animal"),
    "butterfly": (flyers.butterfly, 0.04, "animal"),
    "beetle": (flyers.beetle, 0.035, "animal"),
    "crawler": (flyers.crawler, 0.015, "animal"),
    "fish": (flyers.fish, 0.035, "animal"),
    "octopus": (flyers.octopus, 0.01, "animal"),
    "car": (things.car, 0.03, "thing"),
    "aircraft": (things.aircraft, 0.02, "thing"),
    "boat": (things.boat, 0.01, "thing"),
    "seat": (things.seat, 0.02, "thing"),
    "chest": (things.chest, 0.03, "thing"),
    "vessel": (things.vessel, 0.02, "thing"),
    "building": (things.building, 0.015, "thing"),
    "plant": (things.plant, 0.015, "thing"),
    "tool": (things.tool, 0.015, "thing"),
    "food": (things.food, 0.01, "thing"),
    "composition": (things.composition, 0.03, "thing"),
}
