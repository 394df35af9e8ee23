"""Elevation and imagery that is open to everyone: catalogues, their files, and what they must be read as."""
