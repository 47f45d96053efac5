"""Single links in virtual time: what the transport does on links that it was not tuned for.

`traces` (rate, delay and MTU over time) -> `path` (queue, loss, jitter, reordering, half-duplex hops) <- `network`
(cores of `udp_mesh`) and `tcp` (foreign flows: `cubic`, `bbr`). `trial` measures one link, `cells` lists them.
"""
