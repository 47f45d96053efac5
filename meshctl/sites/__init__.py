"""Sites with a worker of their own: what the operator sends there, how it is executed, and what comes back.

The operator's side: `part` (the part of the inventory that a site needs) and `order` (the signed order to execute one
plan) -> `uplink` (requests to the worker: `ssh_uplink`, `nats_uplink`; `connect` chooses) -> `dispatch` (the plans and
runs of all sites of a command).

The site's side: `worker` answers requests on standard input and output; `runs` keeps each run in a directory, and
`runner` executes one, without the uplink, until its end. A permanent worker (`nats_worker`, `service`) gets stored
orders and publishes events.

Over NATS: `subjects` and `chunks` (names and pieces), `envelope` (who wrote it, who can read it), `nats_client`.
"""
