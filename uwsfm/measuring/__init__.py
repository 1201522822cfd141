"""Distances, areas, heights and angles in a finished model, with deviations."""
