"""Bones and pairs to learn from and to be judged on: parametric bones, shape models, test protocols, splits by person."""
