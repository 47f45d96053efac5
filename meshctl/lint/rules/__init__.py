"""The rules, one file per subject. Codes are stable: a retired code is never reused."""
