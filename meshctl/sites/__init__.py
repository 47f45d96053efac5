"""Sites with a worker of their own: what the operator sends there, how it is executed, and what comes back.

The operator's side: `part` (the part of the inventory that a site needs) and `order` (the signed order to execute one
plan) -> `uplink` (requests to the worker over SSH) -> `dispatch` (the plans and runs of all sites of a command).

The site's side: `worker` answers requests on standard input and output; `runs` keeps each run in a directory, and
`runner` executes one, without the uplink, until its end.
"""
