"""Peers that speak the legacy format."""
