"""Peer discovery and identity: heartbeats in, sessions and peers out."""
