"""Turbulence on images."""
