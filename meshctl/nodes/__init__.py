"""The fleet's radios as meshctl reaches and knows them: connections, host keys, observations, desired state."""
