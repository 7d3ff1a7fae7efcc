"""Source, target, sensor and crop: the inputs of a registration, cleaned and prepared."""
