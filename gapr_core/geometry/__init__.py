"""Geometry without policy: rigid motions, neighbours, distance fields, visibility, curvature."""
