"""export, deploy, twin: a policy leaves the toolkit."""

import os
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from toolkit.cli.judging import check_signer
from toolkit.cli.names import bundle_roles, find_arm, find_pick, trained_policies
from toolkit.cli.terminal import Progress, emit
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told

if TYPE_CHECKING:
    import subprocess

    from toolkit.bundle.reading import Bundle
    from toolkit.deploy.drivers.sim import SimDriver

FormName = Literal["osc", "pose", "joint"]
PaceName = Literal["real", "lockstep"]
DriverName = Literal["sim", "ur", "franka", "kortex", "ros2"]

TOKEN = "META_EVOLVE_TWIN_TOKEN"
"""Holds the token of a twin that other machines can reach: on a command line everybody on the machine could read it."""
OWNER = "META_EVOLVE_TWIN_OWNER"
"""Set for a twin that a deployment starts: the process whose end is also the twin's, however it ends."""


def export(run: Annotated[Path, tyro.conf.Positional], target: str, out: Path, stressed: Path | None = None, sign: Path | None = None,
           json: bool = False) -> None:
    """Write a target's policy as a bundle, a folder and a .zip: named observations in, robosuite's own action out.

    Args:
        run: a run folder.
        target: which target.
        out: folder of the bundle; made if needed. The .zip lies beside it.
        stressed: folder that stress --out wrote for this policy; its ranges go into the manifest and the bundle's README.
        sign: OpenSSH private key that signs it; its public key proves it: verify --signed-by KEY.pub.
        json: print the manifest.
    """
    content, policies, _ = trained_policies(run, target)
    from toolkit.export.labels import LABEL_EPISODES, holds_of, label_of, lineage_of
    from toolkit.export.packing import write_bundle

    robot, task = find_arm(target), find_pick(content["task"])
    lineage = lineage_of(run, target)  # before the label's episodes: a damaged run is told of at once
    holds = holds_of(stressed, run / f"{target}.policy.safetensors", target, task.name) if stressed else ()
    with Progress("export", quiet=json) as progress:
        label = label_of(run, robot, task, policies[target], progress.count(f"{target}, unmodified", LABEL_EPISODES))
        manifest = write_bundle(policies[target], robot, task, content, lineage, label, out,
                                lambda what: progress.show(f"export {target}", what, now=True), key=sign, holds=holds)
    emit(manifest.to_json(), json, f"{out} and {out}.zip: ONNX against NumPy {manifest.golden.onnx_max_abs_error:.1e}; prove it with: "
                                   + told("verify", out))


def deploy(
    bundle: Annotated[str, tyro.conf.Positional],
    driver: DriverName = "sim",
    episodes: int = 10,
    seed: int = 0,
    form: FormName = "osc",
    pace: PaceName = "real",
    connect: str | None = None,
    token: str | None = None,
    log: Path | None = None,
    dry_run: bool = False,
    host: str | None = None,
    ticks: int = 20,
    signed_by: Path | None = None,
    json: bool = False,
) -> None:
    """Move an arm with a bundle, through the safety filter. The arm is the twin: robosuite's robot in a process of its own.

    This side needs neither torch nor robosuite. The twin starts by itself, or beforehand, perhaps in another environment or
    on another machine, with: meta-evolve twin BUNDLE. Real arms are driven from a few lines of Python: docs/deploy.md. With --dry-run
    any of them is read, and what would be sent is printed; nothing is sent.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle.
        driver: which arm: sim (the twin), or, with --dry-run, ur, franka, kortex (Kinova Gen3) or ros2.
        episodes: how many.
        seed: shifts the episodes' starts; they are those of evaluate and verify.
        form: of the commands: osc (robosuite's own deltas), pose (poses in the base frame), joint (angles, through mink).
        pace: real (the twin's physics follows the clock) or lockstep (it waits for each command; repeatable).
        connect: HOST:PORT of a twin that already runs.
        token: that it printed, if other machines can reach it; default: from the environment's META_EVOLVE_TWIN_TOKEN.
        log: file for one JSON line per tick; look at it with: meta-evolve view FILE.
        dry_run: open nothing that can move the arm; read it, and print what would be sent. For a real arm give --form joint.
        host: address of the arm, for --dry-run with ur, franka or kortex.
        ticks: of a dry run.
        signed_by: OpenSSH public key; a bundle that its holder has not signed is refused.
        json: print one JSON object.
    """
    if driver != "sim" and not dry_run:
        raise ToolkitError(f"--driver {driver} moves an arm only from Python, with your cameras (docs/deploy.md: A real arm); "
                           "from the command line add --dry-run")
    if dry_run and (log is not None or (driver != "sim" and connect is not None)):
        raise ToolkitError("a dry run writes no log, and connects to a twin only with --driver sim; leave out --log or --connect")
    if ticks < 1:
        raise ToolkitError(f"ticks is {ticks}; give at least one")
    if episodes < 1 or seed < 0:
        raise ToolkitError(f"episodes is {episodes} and seed {seed}; give at least one episode and a seed from 0 on")
    from toolkit.bundle.reading import load_bundle
    from toolkit.deploy.drivers.sim import SimDriver

    loaded = load_bundle(bundle)
    if signed_by is not None:
        check_signer(loaded, signed_by)
    if driver != "sim":
        from toolkit.cli.listening import dry, listener

        dry(loaded, driver, *listener(loaded, driver, host), form, ticks, json)
        return
    twin = None
    if connect is None:
        twin, port = start_twin(bundle, pace)
        arm = SimDriver("127.0.0.1", port)
    else:
        arm = SimDriver(*_address(connect), token=token if token is not None else os.environ.get(TOKEN, ""))
    try:
        if dry_run:
            from toolkit.cli.listening import ListenedTwin, dry
            from toolkit.runs.seeds import EVALUATION_SEEDS

            dry(loaded, driver, ListenedTwin(arm, EVALUATION_SEEDS + seed * 10**6), arm.leave, form, ticks, json)
            return
        content = _deploy(loaded, arm, episodes, seed, form, pace, log, json)
    finally:
        if twin is not None:
            arm.close()
            twin.terminate()
            twin.wait()
    content["driver"] = driver
    emit(content, json, _deployed(content))


def _deploy(
    bundle: "Bundle", arm: "SimDriver", episodes: int, seed: int, form: FormName, pace: PaceName, log: Path | None, quiet: bool
) -> dict[str, Any]:
    """Play the episodes; returns what ``deploy --json`` prints, but for the driver's name."""
    import numpy as np

    from toolkit.deploy.runtime import Runtime, TickLog, play, wilson_interval
    from toolkit.runs.seeds import EVALUATION_SEEDS

    manifest = bundle.manifest
    info = arm.connect()
    if arm.pace != pace:
        played = {"real": "follows the clock", "lockstep": "waits for each command"}.get(arm.pace, "does not say its pace")
        raise ToolkitError(f"the twin at {arm.where} {played}, but --pace is {pace}; start it with --pace {pace}, or give its own here")
    runtime = Runtime(bundle, info, form)
    record = TickLog(log, {"robot": manifest.robot.name, "task": manifest.task.name, "form": form, "pace": pace,
                           "policy_hz": manifest.policy_hz})
    outcomes, behind, successes = [], 0.0, 0
    with Progress("deploy", quiet) as progress:
        shown = progress.count(f"{manifest.robot.name} twin", episodes)
        try:
            for episode in range(episodes):
                arm.begin(EVALUATION_SEEDS + seed * 10**6 + episode)
                outcome = play(runtime, arm, record, pace, episode)
                succeeded, late = arm.result()
                outcomes.append(outcome)
                successes, behind = successes + succeeded, max(behind, late)
                shown(episode + 1, successes)
        except ToolkitError as error:  # the arm's side has gone: say what is known, and that it is not all
            raise ToolkitError(f"episode {len(outcomes) + 1} of {episodes} was not finished, {successes} of the {len(outcomes)} before it "
                               f"succeeded: {error}") from None
        finally:
            record.close()
    ticks = np.concatenate([outcome.tick_ms for outcome in outcomes] or [[]])
    faults: Counter = sum((outcome.faults for outcome in outcomes), Counter())
    low, high = wilson_interval(successes, episodes)
    return {
        "target": manifest.robot.name, "form": form, "pace": pace, "episodes": episodes, "successes": successes,
        "success_rate": successes / episodes, "ci95": [low, high], "label": [manifest.success.successes, manifest.success.episodes],
        "agrees": high >= manifest.success.ci95[0], "ticks": len(ticks), "held_ticks": sum(outcome.held for outcome in outcomes),
        "faults": dict(faults), "stopped": [outcome.stopped for outcome in outcomes if outcome.stopped],
        "late_ticks": sum(outcome.late for outcome in outcomes), "unknown_ticks": sum(outcome.warnings for outcome in outcomes),
        "tick_ms": dict(zip(("p50", "p99", "max"), np.percentile(ticks, [50, 99, 100]).tolist(), strict=True)) if len(ticks) else None,
        "twin_behind_s": behind, "log": str(log) if log else None, "log_trouble": record.trouble or None,
    }


def _deployed(content: dict[str, Any]) -> str:
    """The result for people."""
    low, high = content["ci95"]
    lines = [f"{content['target']} twin, {content['form']} commands, {content['pace']}: {content['successes']} of {content['episodes']} "
             f"(95 %: {low:.2f} to {high:.2f}); label {content['label'][0]} of {content['label'][1]}: "
             f"{'agrees' if content['agrees'] else 'DISAGREES'}"]
    if content["tick_ms"]:
        lines.append("tick {p50:.2f} ms (99 %: {p99:.2f}, longest {max:.2f})".format(**content["tick_ms"])
                     + f"; {content['late_ticks']} of {content['ticks']} ticks late, {content['held_ticks']} held")
    lines += [f"stopped: {reason}" for reason in content["stopped"]]
    if content["log_trouble"]:
        lines.append(f"log: {content['log_trouble']}")
    elif content["log"]:
        lines.append(f"log: {content['log']}; look at it with: {told('view', content['log'])}")
    return "\n".join(lines)


def start_twin(bundle: str, pace: PaceName) -> tuple["subprocess.Popen", int]:
    """A twin in a process of its own, and the port on which it listens."""
    import subprocess

    command = [sys.executable, "-m", "toolkit.cli", "twin", "--pace", pace, "--", bundle]
    twin = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {OWNER: str(os.getpid())})
    for line in twin.stdout or ():  # whatever else is printed on the way is not ours
        if line.startswith("twin of "):
            return twin, int(line.rsplit(":", 1)[1])
    status = twin.wait()
    raise ToolkitError(f"the twin did not start (exit status {status}, see above); it needs robosuite: install all of meta-evolve, or "
                       "give --connect")


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port[:6]) < 2**16:
        raise ToolkitError(f"--connect {text} is no HOST:PORT, such as 127.0.0.1:5005; ports go from 1 to 65535")
    return host.removeprefix("[").removesuffix("]"), int(port)


def twin(
    bundle: Annotated[str, tyro.conf.Positional], port: int = 0, host: str = "127.0.0.1", pace: PaceName = "real"
) -> None:
    """Serve the unmodified robosuite robot of a bundle as an arm on a socket, until the runtime closes it.

    Args:
        bundle: folder, .zip, or the name of a shipped bundle; names robot and task.
        port: to listen on; 0: any free one, which is printed.
        host: address to listen on. Beyond this machine only who knows the token that is printed can move the simulated robot, or end
            it; nothing else can be done there. META_EVOLVE_TWIN_TOKEN sets the token.
        pace: real (physics follows the clock) or lockstep (it waits for each command).
    """
    import secrets
    import socket


    if not 0 <= port < 2**16:
        raise ToolkitError(f"port is {port}; give one from 1 to 65535, or 0 for any that is free")
    _, robot, task = bundle_roles(bundle)
    from toolkit.export.twin import Twin, serve

    try:
        listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ToolkitError(f"port {port} of {host} cannot be listened on ({why}); choose another --port or --host") from None
    with listener:
        served = Twin(robot, task, pace)
        listener.listen()  # whoever comes earlier is not kept waiting, but tries again
        token = "" if _loopback(listener) else os.environ.get(TOKEN) or secrets.token_urlsafe(18)
        if token and not os.environ.get(TOKEN):
            print(f"token {token}", flush=True)
        print(f"twin of {robot.name} at {host}:{listener.getsockname()[1]}", flush=True)
        owner = os.environ.get(OWNER)
        serve(served, listener, orphaned=lambda: owner is not None and os.getppid() != int(owner), token=token)


def _loopback(listener: Any) -> bool:
    """Whether a socket can be reached from this machine alone."""
    import ipaddress

    return ipaddress.ip_address(listener.getsockname()[0].split("%")[0]).is_loopback
