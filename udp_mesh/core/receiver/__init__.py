"""The receiving half of a session: opened datagrams in, whole messages and acknowledgements out."""
