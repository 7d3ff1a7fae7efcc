"""Bones and pairs to learn from and be judged on: parametric bones, shape models, test protocols, splits by subject."""
