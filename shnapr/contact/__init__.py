"""Nonlocal contact of shells with themselves and each other: arrays in, arrays out, and systems with it."""

from shnapr.contact.kernels import Kernel, LinearKernel, SmoothedKernel
from shnapr.contact.recipe import ContactRecipe
from shnapr.contact.self_contact import ContactForces, Neighbours, SelfContact
from tigar_x.moved import guide

__all__ = ["ContactForces", "ContactRecipe", "Kernel", "LinearKernel", "Neighbours", "SelfContact", "SmoothedKernel"]
__getattr__ = guide(__name__)
