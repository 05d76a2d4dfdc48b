// Draws a picture through a lattice. Every pixel of the target looks up its cell and samples the source there, the
// lattice bilinear in its cells: what the service's renderers do, so the preview is what the download will be.

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D image;
uniform sampler2D lattice;
uniform vec2 size;
out vec4 colour;
void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  ivec2 points = textureSize(lattice, 0);
  vec2 place = pixel / size * vec2(points - 1);
  ivec2 cell = clamp(ivec2(place), ivec2(0), points - 2);
  vec2 into = place - vec2(cell);
  vec2 top = mix(texelFetch(lattice, cell, 0).xy, texelFetch(lattice, cell + ivec2(1, 0), 0).xy, into.x);
  vec2 bottom = mix(texelFetch(lattice, cell + ivec2(0, 1), 0).xy, texelFetch(lattice, cell + ivec2(1, 1), 0).xy, into.x);
  vec2 source = mix(top, bottom, into.y);
  vec2 tolerance = 1.0 + 2.0 / 64.0 / size;
  bool outside = any(greaterThan(abs(source), tolerance));
  colour = outside ? vec4(0.0, 0.0, 0.0, 1.0) : texture(image, (source + 1.0) * 0.5);
}`;

/** @returns {{show(picture: HTMLCanvasElement): void, draw(lattice: object): void}} */
export function createRenderer(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: false, depth: false, preserveDrawingBuffer: true });
  return gl ? new GlRenderer(canvas, gl) : new PlainRenderer(canvas);
}

class GlRenderer {
  constructor(canvas, gl) {
    this.canvas = canvas;
    this.gl = gl;
    this.last = {};
    this.prepare();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.prepare();
      if (this.last.picture) this.show(this.last.picture);
      if (this.last.lattice) this.draw(this.last.lattice);
    });
  }

  prepare() {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`The preview's shader does not link: ${gl.getProgramInfoLog(program)}`);
    }
    gl.useProgram(program);
    gl.uniform1i(gl.getUniformLocation(program, "image"), 0);
    gl.uniform1i(gl.getUniformLocation(program, "lattice"), 1);
    this.size = gl.getUniformLocation(program, "size");
    for (const [unit, filter] of [[0, gl.LINEAR], [1, gl.NEAREST]]) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    }
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  show(picture) {
    const { gl, canvas } = this;
    this.last.picture = picture;
    canvas.width = picture.width;
    canvas.height = picture.height;
    gl.activeTexture(gl.TEXTURE0);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  }

  draw(lattice) {
    const { gl, canvas } = this;
    this.last.lattice = lattice;
    gl.activeTexture(gl.TEXTURE1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RG32F, lattice.columns, lattice.rows, 0, gl.RG, gl.FLOAT, lattice.source);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.uniform2f(this.size, canvas.width, canvas.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

/** The same without WebGL 2, on the processor. */
class PlainRenderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  show(picture) {
    this.canvas.width = picture.width;
    this.canvas.height = picture.height;
    this.from = picture.getContext("2d").getImageData(0, 0, picture.width, picture.height).data;
  }

  draw({ rows, columns, source }) {
    const { width, height } = this.canvas, { from } = this;
    const made = this.context.createImageData(width, height), to = made.data;
    for (let j = 0, out = 0; j < height; j++) {
      const place = ((j + 0.5) / height) * (rows - 1), r = Math.min(Math.floor(place), rows - 2), v = place - r;
      for (let i = 0; i < width; i++, out += 4) {
        const along = ((i + 0.5) / width) * (columns - 1), c = Math.min(Math.floor(along), columns - 2), u = along - c;
        const a = 2 * (r * columns + c), b = a + 2 * columns;
        const at = (k) => (source[a + k] * (1 - u) + source[a + 2 + k] * u) * (1 - v) + (source[b + k] * (1 - u) + source[b + 2 + k] * u) * v;
        const x = ((at(0) + 1) * width) / 2 - 0.5, y = ((at(1) + 1) * height) / 2 - 0.5;
        to[out + 3] = 255;
        if (x < -0.516 || y < -0.516 || x > width - 0.484 || y > height - 0.484) continue;
        const x0 = Math.floor(x), y0 = Math.floor(y), fx = x - x0, fy = y - y0;
        const left = Math.max(x0, 0), right = Math.min(x0 + 1, width - 1);
        const top = 4 * width * Math.max(y0, 0), bottom = 4 * width * Math.min(y0 + 1, height - 1);
        for (let k = 0; k < 4; k++) {
          const high = from[top + 4 * left + k] * (1 - fx) + from[top + 4 * right + k] * fx;
          const low = from[bottom + 4 * left + k] * (1 - fx) + from[bottom + 4 * right + k] * fx;
          to[out + k] = high * (1 - fy) + low * fy;
        }
      }
    }
    this.context.putImageData(made, 0, 0);
  }
}
