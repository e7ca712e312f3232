// Draws splats with WebGL2: moves and projects them, blends them in order, adds the background.

import { FileError } from "./decode.js";
import { bodiesAt } from "./moving.js";
import { backgroundShader, cornerShader, noFragments, PLACED, placeShader, spotShader, TABLE_WIDTH,
  wholeShader } from "./shaders.js";
import { curveCounts, ownCurvesAt } from "./tables.js";

const STRIDE = 4 * Object.values(PLACED).reduce((sum, count) => sum + count, 0);

/** Draws to a canvas; one is made anew when the browser takes the graphics card away. */
export class Drawing {
  /** Throws FileError where there is no WebGL2. */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: false, powerPreference: "high-performance",
    });
    if (!gl) {
      throw new FileError("This browser has no WebGL2, or it is switched off: the scene needs it.");
    }
    this.gl = gl;
    this.canvas = canvas;
    this.half = Boolean(gl.getExtension("EXT_color_buffer_float")
      ?? gl.getExtension("EXT_color_buffer_half_float"));
    this.corners = this.program(cornerShader, spotShader);
    this.over = this.program(wholeShader, backgroundShader);
    this.target = gl.createTexture();
    this.framebuffer = gl.createFramebuffer();
    this.size = [0, 0];
    this.scene = null;
  }

  /** Take what the worker has made of a file in place of what was there. */
  load(scene) {
    const { gl } = this;
    this.drop();
    const { header, parts, tables } = scene;
    const { own, colours } = curveCounts(parts);
    const moves = header.moving > 0;
    this.placing = this.program(placeShader({
      DEGREE: header.sh_degree, MOVING: header.moving, LIVES: tables.lives ? 1 : 0,
      NEIGHBOURS: tables.followed ? Math.max(1, header.bodies.neighbours) : 0,
      OWN: moves ? own : 0, COLOURS: moves ? colours : 0,
    }), noFragments, Object.keys(PLACED));
    const formats = {
      geometry: gl.RGBA32F, rest: gl.RGBA16F, lives: gl.RGBA32F, followed: gl.RG32F,
      own: gl.RGBA32F, own_ends: gl.RGBA32F, own_which: gl.R32F,
      colours: gl.RGBA16F, colour_ends: gl.R32F, colour_which: gl.R32F,
      bodies: gl.RGBA32F, curves: gl.R32F,
    };
    this.tables = Object.fromEntries(Object.entries(formats).map(([name, format]) => (
      [name, new Table(gl, format, tables[name])])));
    this.scene = { header, parts, moves, bodies: Boolean(tables.followed) };
    this.count = header.splats;
    this.makeBuffers();
    this.drawn = 0; // splats in the last order
    this.time = null;
  }

  makeBuffers() {
    const { gl, count } = this;
    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * Math.max(1, count), gl.DYNAMIC_DRAW);
    this.ordered = gl.createVertexArray();
    gl.bindVertexArray(this.ordered);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    this.placed = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.placed);
    gl.bufferData(gl.ARRAY_BUFFER, STRIDE * Math.max(1, count), gl.DYNAMIC_COPY);
    this.instances = gl.createVertexArray();
    gl.bindVertexArray(this.instances);
    let offset = 0;
    Object.values(PLACED).forEach((size, place) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, STRIDE, offset);
      gl.vertexAttribDivisor(place, 1);
      offset += 4 * size;
    });
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.feedback = gl.createTransformFeedback();
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.placed);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
  }

  drop() {
    if (!this.scene) return;
    const { gl } = this;
    Object.values(this.tables).forEach((table) => gl.deleteTexture(table.texture));
    gl.deleteBuffer(this.order);
    gl.deleteBuffer(this.placed);
    gl.deleteVertexArray(this.ordered);
    gl.deleteVertexArray(this.instances);
    gl.deleteTransformFeedback(this.feedback);
    gl.deleteProgram(this.placing.program);
    this.scene = null;
  }

  /** Take the numbers of the splats, from back to front. */
  setOrder(order) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.drawn = order.length;
  }

  /** Draw the scene at a time in [0, 1] through a view, in the last order, over a colour. */
  draw(view, time, background) {
    const { gl } = this;
    this.resize(view.width, view.height);
    if (this.drawn) this.place(view, time);
    this.blend(0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.over.program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target);
    gl.uniform1i(this.over.at("target"), 0);
    gl.uniform3fv(this.over.at("background"), background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Return how deep the scene is at a pixel of the last picture, or null where nothing is. */
  depthAt(x, y, most) {
    const { gl } = this;
    const at = [Math.floor(x), Math.floor(y)];
    const unit = this.half ? 1 : most;
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...at, 1, 1);
    this.blend(unit);
    gl.disable(gl.SCISSOR_TEST);
    const pixel = this.half ? new Float32Array(4) : new Uint8Array(4);
    gl.readPixels(...at, 1, 1, gl.RGBA, this.half ? gl.FLOAT : gl.UNSIGNED_BYTE, pixel);
    const full = this.half ? 1 : 255;
    return pixel[3] > 0.1 * full ? unit * pixel[0] / pixel[3] : null;
  }

  /** Return the canvas after a draw(), row by row from the top, four bytes a pixel. */
  pixels() {
    const { gl } = this;
    const [width, height] = this.size;
    const upwards = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upwards);
    const found = new Uint8Array(upwards.length);
    for (let row = 0; row < height; row++) {
      const from = 4 * width * row;
      found.set(upwards.subarray(from, from + 4 * width), 4 * width * (height - 1 - row));
    }
    return found;
  }

  resize(width, height) {
    const { gl, canvas } = this;
    if (this.size[0] === width && this.size[1] === height) return;
    this.size = [width, height];
    Object.assign(canvas, { width, height });
    gl.bindTexture(gl.TEXTURE_2D, this.target);
    const [inside, type] = this.half ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, gl.RGBA, type, null);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.target, 0);
    gl.viewport(0, 0, width, height);
  }

  /** Move and project every splat, in the last order. */
  place(view, time) {
    const { gl, placing } = this;
    const { parts, moves, bodies } = this.scene;
    if (moves && time !== this.time) {
      if (bodies) this.tables.bodies.fill(bodiesAt(parts, time));
      this.tables.curves.fill(Float32Array.from(ownCurvesAt(parts, time)));
    }
    this.time = time;
    gl.useProgram(placing.program);
    Object.entries(this.tables).forEach(([name, { texture }], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(placing.at(name), unit);
    });
    const m = view.world_to_camera;
    const eye = [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]));
    gl.uniformMatrix4fv(placing.at("world_to_camera"), true, m);
    gl.uniform2f(placing.at("focal"), view.fx, view.fy);
    gl.uniform2f(placing.at("middle"), view.cx, view.cy);
    gl.uniform2f(placing.at("size"), view.width, view.height);
    gl.uniform3fv(placing.at("eye"), eye);
    gl.uniform1f(placing.at("time"), time);
    gl.bindVertexArray(this.ordered);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.drawn);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.bindVertexArray(null);
  }

  /** Blend colours to the target, or depths in a unit that is not 0. */
  blend(depthUnit) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!this.drawn) return;
    gl.useProgram(this.corners.program);
    gl.uniform2f(this.corners.at("size"), ...this.size);
    gl.uniform1f(this.corners.at("depth_unit"), depthUnit);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.instances);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
    gl.bindVertexArray(null);
  }

  /** Compile a program; `captured` names what is written for each vertex. */
  program(vertex, fragment, captured = []) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      gl.deleteShader(shader); // goes with the program
    }
    if (captured.length) gl.transformFeedbackVaryings(program, captured, gl.INTERLEAVED_ATTRIBS);
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      const why = [gl.getProgramInfoLog(program), ...logs].join(" ").trim();
      throw new FileError(`The graphics card cannot draw this scene: ${why}`);
    }
    const places = new Map();
    const at = (name) => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
      return places.get(name);
    };
    return { program, at };
  }
}

/** Numbers in a texture, in rows of TABLE_WIDTH texels. */
class Table {
  constructor(gl, format, values) {
    this.gl = gl;
    this.format = format;
    this.texture = gl.createTexture();
    this.rows = 0;
    this.fill(values ?? new Float32Array(0));
  }

  /** Take other values, as many as before or not. */
  fill(values) {
    const { gl } = this;
    const [kind, channels] = new Map([
      [gl.R32F, [gl.RED, 1]], [gl.RG32F, [gl.RG, 2]],
      [gl.RGBA32F, [gl.RGBA, 4]], [gl.RGBA16F, [gl.RGBA, 4]],
    ]).get(this.format);
    const texels = values.length / channels;
    this.reserve(Math.max(1, Math.ceil(texels / TABLE_WIDTH)));
    const whole = Math.floor(texels / TABLE_WIDTH);
    const put = (row, width, height, from) => {
      if (width * height === 0) return;
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, kind, gl.FLOAT, values, from);
    };
    put(0, TABLE_WIDTH, whole, 0);
    put(whole, texels - whole * TABLE_WIDTH, 1, whole * TABLE_WIDTH * channels);
  }

  /** Bind the texture, with room for so many rows. */
  reserve(rows) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (rows === this.rows) return;
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new FileError("The scene has more splats than the graphics card of this device can hold.");
    }
    gl.deleteTexture(this.texture);
    this.texture = gl.createTexture();
    this.rows = rows;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, TABLE_WIDTH, rows);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    }
  }
}
