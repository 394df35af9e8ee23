"""Physically-based relighting of large mountain landscapes: any place, any date, any hour."""

__version__ = "0.1.0"
