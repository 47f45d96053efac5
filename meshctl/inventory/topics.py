"""A topic's document -> the model's value."""

from __future__ import annotations

from meshctl.inventory.documents import ReductionDocument, TopicDocument, TopicLogDocument
from meshctl.model import JpegEncoding, Reduction, Topic, TopicLog


def topic_of(name: str, document: TopicDocument) -> Topic:
    """The topic `name`."""
    return Topic(
        name=name,
        priority=document.priority,
        topic_class=document.topic_class,
        type_name=document.type_name,
        reliable=document.reliable,
        sources=tuple(document.sources),
        destinations=tuple(document.destinations),
        rate_hz=document.rate_hz,
        size_bytes=document.size_bytes,
        keep_last=document.keep_last,
        deadline_s=document.deadline_s,
        rate_limit_bytes_per_s=document.rate_limit_bytes_per_s,
        compression=document.compression,
        outbox=document.outbox,
        outbox_bytes=document.outbox_bytes,
        outbox_on_disk=document.outbox_on_disk,
        repair=document.repair,
        log=_log(document.log) if document.log is not None else None,
        delta=document.delta,
        delta_bytes=document.delta_bytes,
        reduce=_reduction(document.reduce) if document.reduce is not None else None,
        always=document.always,
        thin=document.thin,
        thin_links=document.thin_links,
        thin_period_s=document.thin_period_s,
    )


def _reduction(document: ReductionDocument) -> Reduction:
    jpeg = document.encode
    return Reduction(
        rate_hz=document.rate_hz,
        encode=None if jpeg is None else JpegEncoding(jpeg.quality, jpeg.min_quality, jpeg.scale),
        voxel_m=document.voxel_m,
        max_voxel_m=document.max_voxel_m,
        fields=tuple(document.fields),
        adapt=document.adapt,
    )


def _log(document: TopicLogDocument) -> TopicLog:
    return TopicLog(document.max_items, document.max_bytes, document.max_age_s, document.copies)
