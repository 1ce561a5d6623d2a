"""Programs watched for reaching out: what leaves this machine is written down and refused."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest


# Loaded before the C library, so that it sees compiled programs as well as Python.
SOURCE = r"""
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static void note(const char *what)
{
    char line[400];
    int file = open(getenv("NETWORK_LOG"), O_WRONLY | O_CREAT | O_APPEND, 0600);
    if (write(file, line, snprintf(line, sizeof line, "%s\n", what)) < 0)
        abort();
    close(file);
}

static int leaves(const struct sockaddr *to)
{
    char text[INET6_ADDRSTRLEN] = "";
    if (to && to->sa_family == AF_INET)
        inet_ntop(AF_INET, &((const struct sockaddr_in *)to)->sin_addr, text, sizeof text);
    else if (to && to->sa_family == AF_INET6)
        inet_ntop(AF_INET6, &((const struct sockaddr_in6 *)to)->sin6_addr, text, sizeof text);
    if (!*text || !strncmp(text, "127.", 4) || !strcmp(text, "::1"))
        return 0;
    note(text);
    errno = ENETUNREACH;
    return 1;
}

int connect(int socket, const struct sockaddr *to, socklen_t size)
{
    int (*real)(int, const struct sockaddr *, socklen_t) = dlsym(RTLD_NEXT, "connect");
    return leaves(to) ? -1 : real(socket, to, size);
}

ssize_t sendto(int socket, const void *data, size_t n, int flags, const struct sockaddr *to,
               socklen_t size)
{
    ssize_t (*real)(int, const void *, size_t, int, const struct sockaddr *, socklen_t) =
        dlsym(RTLD_NEXT, "sendto");
    return leaves(to) ? -1 : real(socket, data, n, flags, to, size);
}

int getaddrinfo(const char *node, const char *service, const struct addrinfo *hints,
                struct addrinfo **found)
{
    int (*real)(const char *, const char *, const struct addrinfo *, struct addrinfo **) =
        dlsym(RTLD_NEXT, "getaddrinfo");
    char own[256] = "";
    unsigned char address[16];
    gethostname(own, sizeof own);
    if (node && strcmp(node, "localhost") && strcmp(node, own) &&
        !inet_pton(AF_INET, node, address) && !inet_pton(AF_INET6, node, address)) {
        note(node);
        return EAI_FAIL;
    }
    return real(node, service, hints, found);
}
"""


@dataclass
class Watch:
    """Runs programs as a new user does: without a word to them about tests or telemetry.

    Attributes:
        environment: All that they are given.
    """

    environment: dict[str, str]

    def reached(self) -> set[str]:
        """Names and addresses beyond this machine that were asked for."""
        log = Path(self.environment["NETWORK_LOG"])
        return set(log.read_text().split()) if log.exists() else set()


def watch(folder: Path) -> Watch:
    """A watch whose files are in a folder."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    library, home = folder / "watch.so", folder / "home"
    home.mkdir()
    (folder / "watch.c").write_text(SOURCE)
    call = ["gcc", "-shared", "-fPIC", "-Wall", "-Werror", str(folder / "watch.c"), "-ldl"]
    subprocess.run([*call, "-o", str(library)], check=True)
    kept = {name: os.environ[name] for name in ("PYTHONPATH", "TMPDIR") if name in os.environ}
    return Watch(
        {
            **kept,
            "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
            "HOME": str(home),
            "LD_PRELOAD": str(library),
            "NETWORK_LOG": str(folder / "reached.txt"),
        }
    )
