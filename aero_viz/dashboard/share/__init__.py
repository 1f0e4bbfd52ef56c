"""Flights as files that anybody can open: a web page, a video, a picture, a log."""

from __future__ import annotations

from aero_viz.dashboard.share.share import SUFFIXES, FlightFiles, share

__all__ = ["SUFFIXES", "FlightFiles", "share"]
