"""Calibration of the confidence: pairs to learn from, records of answers, the fit."""
