"""Sends malformed requests, wrong addresses and slow clients to the page of `plenoxel view RUN` or `plenoxel train --view`.

    python tests/browser/hostile.py PORT SECONDS

PORT is that of the address that the program printed. The script opens 64 connections that send one byte now and then and never a whole request, and sends at most
1200 requests, evenly over SECONDS: random bytes, a path of 9000 characters, a length that no number holds, an unknown version, a record of TLS, and pictures
without the secret of the address. It prints how many were sent and how many connections were refused. Compare the time of a training, and its memory, with
those of the same training without it.
"""

import random
import socket
import sys
import time

SLOW, REQUESTS = 64, 1200

# Each with whether it is well-formed, but has no valid secret.
KINDS = [
    (False, lambda: bytes(random.randrange(256) for _ in range(200)) + b"\r\n\r\n"),
    (False, lambda: b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\n\r\n"),
    (False, lambda: b"POST /x HTTP/1.1\r\nContent-Length: 99999999999999999999\r\n\r\n"),
    (False, lambda: b"GET / HTTP/9.9\r\n\r\n"),
    (True, lambda: b"GET /picture?width=99999999&height=-1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
    (False, lambda: b"\x16\x03\x01\x02\x00\x01\x00"),
    (True, lambda: b"GET /" + b"0" * 32 + b"/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
]


def connect(port):
    return socket.create_connection(("127.0.0.1", port), timeout=2)


def send(port, request):
    """Sends a request, and waits for an answer for a fifth of a second. Returns false if the connection was refused."""
    try:
        with connect(port) as client:
            client.sendall(request)
            client.settimeout(0.2)
            try:
                client.recv(4096)
            except OSError:
                pass
        return True
    except OSError:
        return False


def main():
    port, seconds = int(sys.argv[1]), float(sys.argv[2])
    random.seed(1)
    end = time.time() + seconds
    slow = []
    for _ in range(SLOW):
        client = connect(port)
        client.sendall(b"GET / HTTP/1.1\r\nHost: x")
        slow.append(client)
    malformed = secret = refused = 0
    while time.time() < end:
        turn = malformed + secret + refused
        well_formed, request = KINDS[turn % len(KINDS)]
        if not send(port, request()):
            refused += 1
        elif well_formed:
            secret += 1
        else:
            malformed += 1
        try:
            slow[turn % SLOW].sendall(b"y")
        except OSError:
            # The program has closed it.
            pass
        time.sleep(seconds / REQUESTS)
    print(f"{malformed} malformed requests, {secret} without the secret, {SLOW} slow clients, {refused} connections refused")


main()
