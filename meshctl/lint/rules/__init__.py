"""The rules, one file for each thing they look at. Codes are stable: a code that is given up is never given again."""
