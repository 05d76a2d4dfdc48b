"""Cases without end, the same for the same seed."""

from __future__ import annotations

import random
from collections.abc import Iterator
from urllib.parse import quote

from tests.fuzz import seeds
from tests.fuzz.cases import Case, GrpcCase, HttpCase
from tests.fuzz.mutations import mutated

_VALUES = [
    "",
    "nan",
    "-1",
    "1e400",
    "0",
    "1",
    "0.5",
    "true",
    "\x00",
    "🦆",
    "a" * 300,
    "99999999999999999999",
    "jpeg",
    "tiff",
]
_QUERIES = {
    "correct": ["nonlinear", "all"],
    "fit": ["keep", "crop", "full", "0.5"],
    "strength": ["0", "0.7", "1"],
    "border": ["black", "ff00ff", "transparent", "12345678"],
    "quality": ["1", "90"],
    "format": ["jpeg", "png", "webp", "json", "npz", "npz-fixed", "stmap-tiff", "stmap-exr", "ffmpeg", "opencv"],
    "min_confidence": ["0", "1"],
    "what": ["guides", "grid", "displacement"],
    "width": ["1", "2", "64", "65536"],
    "height": ["1", "48", "600"],
    "direction": ["undistort", "redistort"],
    "points": ["2", "9", "129"],
}
_TAKEN = {
    "/v1/correct": ["correct", "fit", "strength", "border", "quality", "format", "min_confidence"],
    "/v1/estimate": ["correct", "fit", "strength", "min_confidence"],
    "/v1/overlay": ["what", "correct", "format"],
    "export": ["format", "width", "height", "direction", "fit", "strength"],
}


class Inputs:
    """Iterates over cases."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        self._pictures = seeds.pictures()
        self._grids = seeds.grids()
        self._imports = list(seeds.imports().items())
        self._messages = list(seeds.messages(self._pictures).items())

    def __iter__(self) -> Iterator[Case]:
        makers = (
            [self._picture] * 8
            + [self._json] * 4
            + [self._import] * 2
            + [self._query] * 3
            + [self._form] * 2
            + [self._garbage]
            + [self._message] * 9
            + [self._stream] * 2
        )
        while True:
            yield self._rng.choice(makers)()

    def _picture(self) -> Case:
        body = self._broken_picture()
        if self._rng.random() < 0.03:  # estimates are slow, and see nothing but pixels
            path = self._rng.choice(("/v1/estimate", "/v1/overlay", "/v1/correct"))
            return self._post(path + self._some_query(path), body)
        path = self._rng.choice(("/v1/correct", "/v1/correct", "/v1/overlay"))
        query = self._some_query(path)
        return self._post(f"{path}{query}{'&' if query else '?'}grid_id={seeds.GRID.id}", body)

    def _json(self) -> Case:
        body = mutated(self._rng, self._rng.choice(self._grids), self._rng.choice(self._grids))
        if self._rng.random() < 0.3:
            target = f"/v1/grids/{self._rng.choice((seeds.GRID.id, 'g0', '%2e%2e', 'x' * 200))}"
            return HttpCase(f"PUT {target} HTTP/1.1\r\n".encode(), body)
        return self._post("/v1/grids", body)

    def _import(self) -> Case:
        kind, body = self._rng.choice(self._imports)
        asked = kind if self._rng.random() < 0.9 else self._rng.choice(self._imports)[0]
        direction = self._rng.choice(("", "&direction=redistort"))
        points = self._rng.choice(("", "&points=9", "&points=2"))
        return self._post(f"/v1/grids/import?format={asked}{direction}{points}", mutated(self._rng, body))

    def _query(self) -> Case:
        grid_id = self._rng.choice((seeds.GRID.id, seeds.GRID.id, "g0", quote(self._rng.choice(_VALUES)) or "-"))
        target = f"/v1/grids/{grid_id}" + self._rng.choice(("", "/export", "/export", "/export"))
        target += self._some_query("export") if target.endswith("export") else ""
        target = self._rng.choice((target, target, target, self._some_target()))
        method = self._rng.choice(("GET", "GET", "GET", "HEAD", "POST", "PUT", "PATCH", "OPTIONS", "TRACE", "BREW"))
        return HttpCase(f"{method} {target} HTTP/1.1\r\n".encode())

    def _form(self) -> Case:
        part = b'--edge\r\nContent-Disposition: form-data; name="image"; filename="a.jpg"\r\n\r\n'
        form = part + self._rng.choice(self._pictures) + b"\r\n--edge--\r\n"
        kind = b"multipart/form-data; boundary=edge"
        if self._rng.random() < 0.3:
            kind = mutated(self._rng, kind).replace(b"\r", b"").replace(b"\n", b"").replace(b"\0", b"")
        head = b"POST /v1/overlay?grid_id=%s HTTP/1.1\r\nContent-Type: %s\r\n" % (seeds.GRID.id.encode(), kind)
        return HttpCase(head, mutated(self._rng, form, part))

    def _garbage(self) -> Case:
        good = self._post("/v1/grids", self._grids[0]).wire
        return HttpCase(
            mutated(self._rng, good, b"Transfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n"), raw=True
        )

    def _message(self) -> Case:
        method, messages = self._rng.choice(self._messages)
        streaming = method.endswith(("CorrectStream", "ServerReflectionInfo"))
        raw = self._rng.choice(messages)
        if method.endswith("/Correct") and self._rng.random() < 0.5:
            return GrpcCase(method, (raw.replace(self._pictures[0], self._broken_picture()),))
        return GrpcCase(method, (mutated(self._rng, raw, self._rng.choice(messages)),), streaming)

    def _stream(self) -> Case:
        method = "/unbend.v1.CorrectionService/CorrectStream"
        messages = dict(self._messages)[method]
        opened = messages[self._rng.randrange(3)]
        frames = [self._rng.choice(messages[3:]) for _ in range(self._rng.randrange(4))]
        sent = [opened, *frames]
        broken = self._rng.randrange(len(sent))
        sent[broken] = mutated(self._rng, sent[broken], self._rng.choice(messages))
        if self._rng.random() < 0.1:
            self._rng.shuffle(sent)
        return GrpcCase(method, tuple(sent), streaming=True)

    def _broken_picture(self) -> bytes:
        return mutated(self._rng, self._rng.choice(self._pictures), self._rng.choice(self._pictures))

    def _post(self, target: str, body: bytes) -> HttpCase:
        return HttpCase(f"POST {target} HTTP/1.1\r\n".encode(), body)

    def _some_query(self, path: str) -> str:
        taken = _TAKEN[path]
        pairs = []
        for name in self._rng.sample(taken, self._rng.randrange(min(4, len(taken)) + 1)):
            value = self._rng.choice(_QUERIES[name])
            if self._rng.random() < 0.1:
                value = self._rng.choice(_VALUES)
            pairs.append(f"{name if self._rng.random() < 0.98 else 'x' + name}={quote(value)}")
        return "?" + "&".join(pairs) if pairs else ""

    def _some_target(self) -> str:
        targets = (
            "/livez",
            "/readyz",
            "/metrics",
            "/docs",
            "/",
            "/openapi.json",
            "/web/../../etc/passwd",
            "//",
            "/%ff%00",
        )
        return self._rng.choice(targets) + self._rng.choice(("", "?a=b", "?%", "?" + "&".join("a" * 500)))
