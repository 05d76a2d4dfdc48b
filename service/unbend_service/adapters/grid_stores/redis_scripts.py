"""What the Redis grid store has the server do in one step.

Keys, all in one hash slot: ``{prefix}:grid:ID`` a packed record, ``{prefix}:stream:ID`` a hash that names its stream
and grid, ``{prefix}:FAMILY:used`` a sorted set of ids by their last use in microseconds, ``{prefix}:claim:ID`` a token,
``{prefix}:camera:NAME`` what is remembered of a camera.
Every key expires by itself as well, so that nothing is left behind by replicas that are gone.
"""

from __future__ import annotations

#: Arguments of every script, in this order, before its own.
_PRELUDE = """
local prefix, now, ttl_us, entries = ARGV[1], tonumber(ARGV[2]), tonumber(ARGV[3]), tonumber(ARGV[4])
if now < 0 then
  local time = redis.call('TIME')
  now = time[1] * 1000000 + time[2]
end

local function digits(number) return string.format('%.0f', number) end
local function key_of(family, id) return prefix .. ':' .. family .. ':' .. id end
local function uses_of(family) return prefix .. ':' .. family .. ':used' end

local function forget(family, id)
  redis.call('ZREM', uses_of(family), id)
  return redis.call('DEL', key_of(family, id))
end

local function is_kept(family, id)
  local used = redis.call('ZSCORE', uses_of(family), id)
  if used and tonumber(used) < now - ttl_us then
    forget(family, id)
    return false
  end
  return redis.call('EXISTS', key_of(family, id)) == 1
end

local function use(family, id)
  local ttl_ms = digits(math.ceil(ttl_us / 1000))
  redis.call('ZADD', uses_of(family), digits(now), id)
  redis.call('PEXPIRE', uses_of(family), ttl_ms)
  redis.call('PEXPIRE', key_of(family, id), ttl_ms)
  local old = redis.call('ZRANGEBYSCORE', uses_of(family), '-inf', '(' .. digits(now - ttl_us), 'LIMIT', 0, 100)
  for _, stale in ipairs(old) do forget(family, stale) end
  local surplus = redis.call('ZCARD', uses_of(family)) - entries
  if surplus > 0 then
    for _, oldest in ipairs(redis.call('ZRANGE', uses_of(family), 0, surplus - 1)) do forget(family, oldest) end
  end
end

local function bound(stream, version)
  if not is_kept('stream', stream) then return false end
  local found = redis.call('HMGET', key_of('stream', stream), 'version', 'stream', 'grid')
  if found[1] ~= version or found[2] ~= stream or not is_kept('grid', found[3]) then return false end
  use('stream', stream)
  use('grid', found[3])
  return {stream, found[3]}
end
"""

#: id, value
PUT = (
    _PRELUDE
    + """
redis.call('SET', key_of('grid', ARGV[5]), ARGV[6])
use('grid', ARGV[5])
return 1
"""
)

#: id -> value or nothing
GET = (
    _PRELUDE
    + """
if not is_kept('grid', ARGV[5]) then return false end
use('grid', ARGV[5])
return redis.call('GET', key_of('grid', ARGV[5]))
"""
)

#: id -> whether it was there
DELETE = (
    _PRELUDE
    + """
local there = is_kept('grid', ARGV[5])
forget('grid', ARGV[5])
return there and 1 or 0
"""
)

#: stream, version, grid, replace -> stream and the grid that is bound now
BIND = (
    _PRELUDE
    + """
local stream, version, grid = ARGV[5], ARGV[6], ARGV[7]
if ARGV[8] == '0' then
  local found = bound(stream, version)
  if found then return found end
end
redis.call('DEL', key_of('stream', stream))
redis.call('HSET', key_of('stream', stream), 'version', version, 'stream', stream, 'grid', grid)
use('stream', stream)
return {stream, grid}
"""
)

#: stream, version -> stream and the grid that is bound, or nothing
STREAM = (
    _PRELUDE
    + """
return bound(ARGV[5], ARGV[6])
"""
)

#: stream, token, lease in milliseconds -> whether the token has the claim
CLAIM = (
    _PRELUDE
    + """
local key, token = key_of('claim', ARGV[5]), ARGV[6]
local holder = redis.call('GET', key)
if holder and holder ~= token then return 0 end
redis.call('SET', key, token, 'PX', ARGV[7])
return 1
"""
)

#: stream, token
RELEASE = (
    _PRELUDE
    + """
local key = key_of('claim', ARGV[5])
if redis.call('GET', key) == ARGV[6] then redis.call('DEL', key) end
return 1
"""
)

#: name -> record or nothing
CAMERA = (
    _PRELUDE
    + """
if not is_kept('camera', ARGV[5]) then return false end
use('camera', ARGV[5])
return redis.call('GET', key_of('camera', ARGV[5]))
"""
)

#: name, 1 if something is known, that, 1 if something takes its place, that -> whether it was swapped
SWAP_CAMERA = (
    _PRELUDE
    + """
local found = is_kept('camera', ARGV[5]) and redis.call('GET', key_of('camera', ARGV[5]))
if ARGV[6] == '1' then
  if found ~= ARGV[7] then return 0 end
elseif found then
  return 0
end
if ARGV[8] == '1' then
  redis.call('SET', key_of('camera', ARGV[5]), ARGV[9])
  use('camera', ARGV[5])
else
  forget('camera', ARGV[5])
end
return 1
"""
)
