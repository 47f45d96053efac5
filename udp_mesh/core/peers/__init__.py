"""Who is there: heartbeats in, sessions and peers out."""
