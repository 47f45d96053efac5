"""The sending half of a session: messages in, packets out, outcomes back."""
