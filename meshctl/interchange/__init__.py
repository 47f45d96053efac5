"""Inventories from and for elsewhere: existing devices, NetBox, NetJSON, label sheets.

`device` holds what one device reports, `device_entries` maps it to inventory entries, `device_differences` compares its
configuration with the one that the entries render to, `device_import` does these in order.
"""
