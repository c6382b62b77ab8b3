"""Who made a bundle: a detached signature of its manifest, whose hashes hold all other files.

Keys and signatures are OpenSSH's (``ssh-keygen -Y``, format SSHSIG, https://github.com/openssh/openssh-portable/blob/master/PROTOCOL.sshsig),
as git signs commits: people have such a key already, and the tool that knows them is part of every system. The namespace keeps a
signature that was given for something else, a commit or a mail, from passing for one of a bundle.
"""

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from toolkit.errors import ToolkitError

TOOL, NAMESPACE, SIGNER = "ssh-keygen", "meta-evolve-bundle", "signer"
"""The last is what a key is called while it is asked; OpenSSH wants a name."""
PATIENCE = 60.0
"""[s] for the tool: a key with a passphrase or on a token asks for it."""


def sign(content: bytes, key: Path) -> bytes:
    """The signature of some bytes.

    Args:
        content: what is signed.
        key: OpenSSH private key, or the public one of a key that an agent holds.

    Raises:
        ToolkitError: no such key, it cannot be used, or OpenSSH is not installed.
    """
    if not key.is_file():
        raise ToolkitError(f"{key} is no key; give an OpenSSH private key, made with: ssh-keygen -t ed25519")
    done = _run(["-Y", "sign", "-f", str(key), "-n", NAMESPACE], content)
    if done.returncode:
        raise ToolkitError(f"{key} does not sign ({_why(done)}); give an OpenSSH private key that you may read")
    return done.stdout


def check_signature(content: bytes, signature: bytes | None, key: Path, where: str) -> None:
    """Refuse what a key has not signed.

    Args:
        content: the signed bytes.
        signature: of ``sign``; None: there is none.
        key: OpenSSH public key, one line, as in id_ed25519.pub.
        where: what is checked, for messages.

    Raises:
        ToolkitError: no signature, another key's, or of other bytes.
    """
    try:
        words = key.read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError) as error:
        raise ToolkitError(f"{key} is no public key ({error}); give the signer's, such as id_ed25519.pub") from None
    if len(words) < 2 or not words[0].startswith(("ssh-", "ecdsa-", "sk-")):
        raise ToolkitError(f"{key} is no public key of OpenSSH; give the signer's, such as id_ed25519.pub")
    if signature is None:
        raise ToolkitError(f"{where} is not signed; ask whoever made it for a signed copy, or leave --signed-by out")
    with TemporaryDirectory() as folder:
        allowed, detached = Path(folder) / "allowed_signers", Path(folder) / "signature"
        allowed.write_text(f'{SIGNER} namespaces="{NAMESPACE}" {words[0]} {words[1]}\n', encoding="ascii")
        detached.write_bytes(signature)
        done = _run(["-Y", "verify", "-f", str(allowed), "-I", SIGNER, "-n", NAMESPACE, "-s", str(detached)], content)
    if done.returncode:
        raise ToolkitError(f"{where} is not as the holder of {key} signed it ({_why(done)}); get it anew from its maker, or give the key "
                           "of who signed it")


def _run(arguments: list[str], content: bytes) -> subprocess.CompletedProcess:
    try:
        return subprocess.run([TOOL, *arguments], input=content, capture_output=True, timeout=PATIENCE)
    except FileNotFoundError:
        raise ToolkitError(f"signatures need OpenSSH's {TOOL}, which is not installed; install openssh-client") from None
    except subprocess.TimeoutExpired:
        raise ToolkitError(f"{TOOL} did not answer in {PATIENCE:.0f} s; load the key into an ssh-agent first") from None


def _why(done: subprocess.CompletedProcess) -> str:
    lines = (done.stderr + done.stdout).decode(errors="replace").strip().splitlines()
    return lines[-1].strip()[:120] if lines else f"exit status {done.returncode}"
