"""Disturbance and drag: what the vehicle model does not explain is estimated and fed forward."""
