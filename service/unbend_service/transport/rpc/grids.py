"""``unbend.v1.GridService``."""

from __future__ import annotations

from unbend.v1 import grid_pb2, grid_pb2_grpc
from unbend_service.application.grids import GridLibrary
from unbend_service.domain.errors import InvalidGrid
from unbend_service.transport.rpc.calls import Context
from unbend_service.transport.rpc.convert import from_record, to_grid, to_guides


class GridServicer(grid_pb2_grpc.GridServiceServicer):
    """Keeps, returns and forgets grids."""

    def __init__(self, grids: GridLibrary) -> None:
        self._grids = grids

    async def GetGrid(  # noqa: N802 the name of the generated base class
        self, request: grid_pb2.GetGridRequest, context: Context
    ) -> grid_pb2.GetGridResponse:
        return grid_pb2.GetGridResponse(record=from_record(await self._grids.get(request.grid_id), whole=True))

    async def PutGrid(  # noqa: N802 as above
        self, request: grid_pb2.PutGridRequest, context: Context
    ) -> grid_pb2.PutGridResponse:
        match request.WhichOneof("content"):
            case "grid":
                record = await self._grids.put_grid(to_grid(request.grid))
            case "guides":
                record = await self._grids.put_guides(to_guides(request.guides))
            case _:
                raise InvalidGrid("Neither a grid nor guides were sent.", allowed="one of grid, guides")
        return grid_pb2.PutGridResponse(record=from_record(record, whole=True))

    async def DeleteGrid(  # noqa: N802 as above
        self, request: grid_pb2.DeleteGridRequest, context: Context
    ) -> grid_pb2.DeleteGridResponse:
        await self._grids.delete(request.grid_id)
        return grid_pb2.DeleteGridResponse()
