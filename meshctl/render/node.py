"""Intent -> templates -> text -> parsed tree -> canonical files, with a marker that identifies them.

Diffs and uploads use the text of the parsed tree, never the template's output: every UCI file has passed our parser,
and does not depend on the layout of its template.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache

from meshctl import uci
from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.model import MASK, Fleet, Node, Secret, SecretRef
from meshctl.render.extra import with_extra
from meshctl.render.facts import NO_FACTS, DeviceFacts, with_board_sections
from meshctl.render.rendered import (
    CONFIG_FOLDER,
    LAN_FILTER_PATH,
    LINKS_PATH,
    MARKER_PATH,
    Rendered,
    RenderedFile,
    replace_secrets,
)
from meshctl.render.template_files import NOT_UCI, TemplateFile
from meshctl.render.templates import Templates
from meshctl.resolve import Intent, resolve
from meshctl.resources import device_script

# A WEP key has 5 characters; shorter values, such as the index in wireless' `key '1'`, are not secret.
_MIN_SECRET_CHARACTERS = 5


class UnknownNode(InvalidInput):
    """A node that is not in the inventory, or not managed."""


def render_fleet(
    fleet: Fleet, secrets: Callable[[SecretRef], Secret], templates: Templates | None = None
) -> Iterator[Rendered]:
    """Every managed node in the inventory's order, one at a time. Raises InvalidInput."""
    shared = templates if templates is not None else Templates.of(fleet)
    return (render(resolve(fleet, node, secrets), shared) for node in fleet.managed())


def render_nodes(
    fleet: Fleet, names: Iterable[str], secrets: Callable[[SecretRef], Secret], templates: Templates | None = None
) -> tuple[Rendered, ...]:
    """The named nodes. Raises InvalidInput with the errors of all of them, without duplicates."""
    shared = templates if templates is not None else Templates.of(fleet)
    rendered = []
    problems: dict[Diagnostic, None] = {}
    for name in names:
        try:
            rendered.append(render_node(fleet, name, secrets, shared))
        except InvalidInput as error:
            problems.update(dict.fromkeys(error.diagnostics))
    if problems:
        raise InvalidInput(problems)
    return tuple(rendered)


def render_node(
    fleet: Fleet,
    name: str,
    secrets: Callable[[SecretRef], Secret],
    templates: Templates | None = None,
    device_facts: DeviceFacts | None = None,
) -> Rendered:
    """One node's files. Raises UnknownNode, or InvalidInput with all invalid values."""
    node = _managed(fleet, name)
    shared = templates if templates is not None else Templates.of(fleet)
    return render(resolve(fleet, node, secrets), shared, device_facts)


def _managed(fleet: Fleet, name: str) -> Node:
    place = Position(fleet.files[0] if fleet.files else fleet.name)
    node = fleet.nodes.get(name)
    if node is None:
        raise UnknownNode(
            [Diagnostic("RND020", Severity.ERROR, place, "", expected="a node of the fleet", found=repr(name))]
        )
    if not node.state.is_managed:
        message = f"{name} is {node.state.value} and has no configuration"
        place = fleet.where("nodes", name).position
        raise UnknownNode([Diagnostic("RND021", Severity.ERROR, place, message)])
    return node


def render(
    intent: Intent, templates: Templates, device_facts: DeviceFacts | None = None, *, plain: Rendered | None = None
) -> Rendered:
    """The files of one node, the same bytes for the same intent, facts and templates.

    `plain` is the same intent rendered before, without facts: it is not rendered again. Raises InvalidInput for a
    template that fails, or whose output is not UCI.
    """
    facts = device_facts or NO_FACTS
    files = list(_files(intent, templates, NO_FACTS)) if plain is None else list(_without_marker(plain))
    # the hash does not cover board-specific sections
    config_hash = _config_hash(files) if plain is None else plain.config_hash
    if facts.compat_version or not templates.are_shipped(intent.operator_parts):
        files = list(_files(intent, templates, facts)) if facts != NO_FACTS else files
    else:
        # the shipped templates read nothing else of the device
        files = [_with_board_sections(file, facts, intent.secrets) for file in files]
    marker = f"fleet={intent.fleet}\nnode={intent.node}\nconfig={config_hash}\n"
    files.append(RenderedFile(MARKER_PATH, 0o644, marker.encode(), marker))
    return Rendered(
        node=intent.node,
        release=str(intent.release),
        files=tuple(sorted(files, key=lambda file: file.path)),
        packages=intent.packages,
        removed_packages=intent.removed_packages,
        config_hash=config_hash,
    )


def _without_marker(rendered: Rendered) -> Iterator[RenderedFile]:
    return (file for file in rendered.files if file.path != MARKER_PATH)


def _with_board_sections(file: RenderedFile, facts: DeviceFacts, secrets: tuple[Secret, ...]) -> RenderedFile:
    if file.package is None:
        return file
    package = with_board_sections(file.package, facts)
    return file if package == file.package else _file(file.path, uci.dump(package), 0o644, secrets, package)


def _files(intent: Intent, templates: Templates, facts: DeviceFacts) -> Iterator[RenderedFile]:
    context = {"intent": intent, "device": facts}
    packages: dict[str, uci.Package] = {}
    for file in templates.files(intent.backend, intent.operator_parts):
        if file.path == LAN_FILTER_PATH and intent.lan_filter is None:
            continue
        text = templates.text(file, intent.backend, intent.operator_parts, context)
        if file.is_uci:
            package = _parsed(file, text)
            packages[package.name] = package
        else:
            yield _file(file.path, text, 0o755 if file.is_executable else 0o644, intent.secrets, None)
    if intent.login.collectors:
        yield _file(LINKS_PATH, device_script("links.sh"), 0o644, intent.secrets, None)
    for name, written in with_extra(packages, intent).items():
        package = with_board_sections(written, facts)
        yield _file(CONFIG_FOLDER + name, uci.dump(package), 0o644, intent.secrets, package)


def _parsed(file: TemplateFile, text: str) -> uci.Package:
    name = file.path.removeprefix(CONFIG_FOLDER)
    try:
        return uci.parse(text, file.path, name=name)
    except InvalidInput as error:
        place = Position(str(file.source))
        message = f"template output is not UCI: {error}"
        raise InvalidInput([Diagnostic(NOT_UCI, Severity.ERROR, place, message)]) from error


def _file(path: str, text: str, mode: int, secrets: tuple[Secret, ...], package: uci.Package | None) -> RenderedFile:
    known = dict.fromkeys((*secrets, *(_written_secrets(package) if package is not None else ())))
    inside = tuple(secret for secret in known if replace_secrets(text, (secret,), lambda _: MASK) != text)
    masked = replace_secrets(text, inside, lambda _: MASK)
    # login keys and mesh keys are readable by root only
    is_private = bool(inside) or path.startswith("etc/dropbear/")
    return RenderedFile(path, mode & 0o700 if is_private else mode, text.encode(), masked, inside, package)


def _written_secrets(package: uci.Package) -> Iterator[Secret]:
    """Keys and passwords in plain text, from `extra_uci` or an operator's template, which must be masked, too."""
    for section in package.sections:
        for name in section.options:
            if uci.is_secret_option(name):
                yield from (Secret(item) for item in section.items(name) if len(item) >= _MIN_SECRET_CHARACTERS)


def _config_hash(files: list[RenderedFile]) -> str:
    """SHA-256 over every file, with each secret replaced by its fingerprint.

    The hash is public (logs, status), so it must not allow cheap password guessing.
    """
    digest = hashlib.sha256()
    for file in sorted(files, key=lambda file: file.path):
        content = replace_secrets(file.content.decode(), file.secrets, _fingerprint).encode()
        digest.update(f"{file.path}\0{file.mode:o}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


# Each derivation takes about 50 ms.
@lru_cache(maxsize=64)
def _fingerprint(secret: Secret) -> str:
    return hashlib.scrypt(secret.reveal().encode(), salt=b"meshctl config hash", n=2**14, r=8, p=1, dklen=32).hex()
