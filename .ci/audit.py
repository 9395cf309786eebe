"""Known vulnerabilities of the installed packages: fails on a finding, and tells what could not be looked up."""

import json
import subprocess
import sys


def main() -> int:
    """Run pip-audit; 1 where it found something."""
    command = [sys.executable, "-m", "pip_audit", "--local", "--format", "json", "--progress-spinner", "off"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
        packages = json.loads(done.stdout)["dependencies"]
    except subprocess.TimeoutExpired:
        sys.stdout.write("pip-audit: nothing was looked up: its service did not answer\n")
        return 0
    except (ValueError, KeyError):
        if not any(word in done.stderr for word in ("Connection", "HTTPError", "ServiceError", "resolve")):
            sys.stderr.write(done.stderr)
            return 1  # not the network: pip-audit itself is broken
        sys.stdout.write(f"pip-audit: nothing was looked up: {done.stderr.strip().splitlines()[-1]}\n")
        return 0
    known = [package for package in packages if "skip_reason" not in package]
    found = [(package, vulnerability) for package in known for vulnerability in package["vulns"]]
    for package, vulnerability in found:
        cure = ", ".join(vulnerability["fix_versions"]) or "none yet"
        sys.stdout.write(f"{package['name']} {package['version']}: {vulnerability['id']}, mended in {cure}\n")
    sys.stdout.write(
        f"pip-audit: {len(found)} vulnerabilities in {len(known)} packages; {len(packages) - len(known)} more are "
        "not known to the service and were not looked up\n"
    )
    return 1 if found else 0


sys.exit(main())
