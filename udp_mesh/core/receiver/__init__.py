"""The receiving half of a session: opened datagrams in, complete messages and acknowledgments out."""
