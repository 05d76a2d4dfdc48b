"""Straighten what people upload to your own FastAPI application, before it goes on.

    python upload_proxy.py --port 8000
    curl --data-binary @photo.jpg localhost:8000/photos -o straight.jpg

Errors of Unbend become the answers that a browser understands: what was wrong with the picture is the sender's to know,
whether the service is busy is for him to try again. Needs `pip install unbend fastapi uvicorn`.
"""

from __future__ import annotations

import argparse
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import uvicorn
from fastapi import FastAPI, Request, Response

import unbend


def make_app(target: str) -> FastAPI:
    """An application with one route, and one connection to Unbend for all requests."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with unbend.AsyncClient(target, timeout_s=20) as client:
            app.state.unbend = client
            yield

    app = FastAPI(lifespan=lifespan)

    @app.post("/photos")
    async def receive(request: Request) -> Response:
        try:
            correction = await app.state.unbend.correct(await request.body(), answer_format="jpeg")
        except unbend.InvalidInput as error:
            return Response(str(error), status_code=422, media_type="text/plain")
        except (unbend.Overloaded, unbend.Unavailable, unbend.DeadlineExceeded):
            return Response("Please try again.", status_code=503, headers={"Retry-After": "1"})
        # here the straight picture would be stored; this application hands it back
        headers = {"X-Straightened": correction.outcome.value, "X-Grid": correction.grid_id}
        return Response(correction.image, media_type="image/jpeg", headers=headers)

    return app


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=8000, help="0 takes a free one [%(default)s]")
    parser.add_argument("--target", default="127.0.0.1:50051", help="host:port of Unbend [%(default)s]")
    options = parser.parse_args()
    uvicorn.run(make_app(options.target), host="127.0.0.1", port=options.port)


if __name__ == "__main__":
    main()
