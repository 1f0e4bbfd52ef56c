"""Stray points: rain, dust and insects near the sensor are no obstacles."""
