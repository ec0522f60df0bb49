// What lies on the graphics device, and one picture of it.

const PALETTE = [
  [0.70, 0.74, 0.80], [0.93, 0.56, 0.30], [0.36, 0.66, 0.86], [0.49, 0.74, 0.40],
  [0.80, 0.50, 0.76], [0.90, 0.76, 0.30], [0.42, 0.76, 0.73], [0.88, 0.46, 0.47],
];
const BACKGROUNDS = { light: [0.96, 0.965, 0.975], white: [1, 1, 1], grey: [0.45, 0.47, 0.5], dark: [0.09, 0.1, 0.12] };
const AXES_SIDE = 84;  // pixels of the corner where the axes are drawn
const AXIS_COLORS = [[0.86, 0.22, 0.2], [0.2, 0.62, 0.24], [0.2, 0.4, 0.9]];
const POSITION = 0, NORMAL = 1, COLOR = 2, UV = 3;
const PICK_WINDOW = 9;  // pixels on a side in which a double click looks for something

class Drawing {
  // Raises where the device refuses; `changed` is called when an image has arrived.
  constructor(gl, scene, changed) {
    this.gl = gl;
    this.scene = scene;
    this.changed = changed;
    const built = builtProgram(gl);
    this.program = built.program;
    this.uniforms = built.uniforms;
    this.blank = this.texture();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4).fill(255));
    this.shapes = scene.items.map((item) => this.uploaded(item));
    this.lines = {};
    this.target = null;
  }

  texture() {
    const texture = this.gl.createTexture();
    this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
    return texture;
  }

  uploaded(item) {
    const gl = this.gl;
    const shape = { item: item, array: gl.createVertexArray(), texture: this.blank, sides: null, bend: 1 };
    const points = decodedPositions(item.positions, this.scene.origin);
    shape.count = points.length / 3;
    gl.bindVertexArray(shape.array);
    this.attribute(POSITION, points, 3, false);
    if (item.colors) this.attribute(COLOR, decoded(item.colors), 3, true);
    if (item.uvs) this.attribute(UV, decoded(item.uvs), 2, false);
    if (item.kind === "mesh") this.uploadFaces(shape, points);
    else if (item.normals) this.attribute(NORMAL, decodedNormals(item.normals), 3, false);
    if (item.kind === "lines") shape.sides = this.indices(decoded(item.lines));
    gl.bindVertexArray(null);
    if (item.texture) this.loadImage(shape);
    return shape;
  }

  uploadFaces(shape, points) {
    const faces = decoded(shape.item.faces);
    const normals = shape.item.normals ? decodedNormals(shape.item.normals) : null;
    const computed = normals ? { normals: normals, bend: meanBend(points, faces, normals) } : smoothNormals(points, faces);
    this.attribute(NORMAL, computed.normals, 3, false);
    shape.bend = normals ? 1 : computed.bend;
    shape.faces = this.indices(faces);
  }

  attribute(location, values, width, bytes) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, width, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, bytes, 0, 0);
  }

  indices(values) {
    const gl = this.gl;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return { buffer: buffer, count: values.length, type: values.BYTES_PER_ELEMENT === 2 ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT };
  }

  // Rows of an image run downwards, texture coordinates upwards.
  loadImage(shape) {
    const gl = this.gl;
    const image = new Image();
    image.onload = () => {
      if (gl.isContextLost() || this.gone) return;
      const described = shape.item.texture;
      shape.texture = this.texture();
      gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
      gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      const around = described.repeat === "mirror" ? gl.MIRRORED_REPEAT : gl.CLAMP_TO_EDGE;
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, around);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, around);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, described.nearest ? gl.NEAREST : gl.LINEAR_MIPMAP_LINEAR);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, described.nearest ? gl.NEAREST : gl.LINEAR);
      if (!described.nearest) gl.generateMipmap(gl.TEXTURE_2D);
      const extension = gl.getExtension("EXT_texture_filter_anisotropic");
      if (extension && !described.nearest) gl.texParameterf(gl.TEXTURE_2D, extension.TEXTURE_MAX_ANISOTROPY_EXT, 4);
      this.changed();
    };
    image.src = shape.item.texture.image;
  }

  // Draw everything that `state` shows.
  draw(view, state) {
    const gl = this.gl;
    const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    gl.viewport(0, 0, width, height);
    gl.clearColor(...BACKGROUNDS[state.background], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    this.begin(view, state);
    for (const shape of this.shapes) if (shape.item.visible) this.drawShape(shape, state);
    if (state.grid) this.drawGrid(state);
    if (state.axes) this.drawAxes(view, width, height);
    gl.bindVertexArray(null);
  }

  begin(view, state) {
    const gl = this.gl, u = this.uniforms;
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(u.toClip, false, view.matrix(this.scene.reach));
    gl.uniform3fv(u.eye, view.eye());
    gl.uniform3fv(u.up, FRAMES[view.up].up);
    gl.uniform2fv(u.heights, this.scene.heights(view.up));
    gl.uniform1i(u.look, state.look);
    gl.uniform1i(u.depthOnly, 0);
    gl.uniform1f(u.pointSize, state.pointSize * state.ratio);
    gl.uniform3f(u.offset, 0, 0, 0);
  }

  bind(shape) {
    const gl = this.gl, u = this.uniforms, item = shape.item;
    gl.bindVertexArray(shape.array);
    if (!item.normals && item.kind !== "mesh") gl.vertexAttrib3f(NORMAL, 0, 0, 0);
    gl.uniform3fv(u.offset, item.offset);
    gl.uniform4f(u.plain, ...item.color, 1);
    gl.uniform1i(u.paint, item.texture && shape.texture !== this.blank ? 2 : item.colors ? 1 : 0);
    gl.uniform1i(u.kind, { mesh: 0, points: 1, lines: 2 }[item.kind]);
    gl.bindTexture(gl.TEXTURE_2D, shape.texture);
  }

  drawShape(shape, state) {
    const gl = this.gl, u = this.uniforms, item = shape.item;
    this.bind(shape);
    if (item.kind === "points") {
      // clouds without colours and normals show their shape by height
      const bare = state.look === 0 && !item.colors && !item.normals && this.scene.items.length === 1;
      gl.uniform1i(u.look, bare ? 4 : state.look);
      gl.drawArrays(gl.POINTS, 0, shape.count);
      gl.uniform1i(u.look, state.look);
    } else if (item.kind === "lines") {
      this.drawSides(shape, item.color, 1);
    } else {
      if (state.faces) {
        gl.uniform1i(u.flatFaces, state.facets === "flat" || (state.facets === "auto" && shape.bend < 0.88) ? 1 : 0);
        gl.enable(gl.POLYGON_OFFSET_FILL);
        gl.polygonOffset(1, 1);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, shape.faces.buffer);
        gl.drawElements(gl.TRIANGLES, shape.faces.count, shape.faces.type, 0);
        gl.disable(gl.POLYGON_OFFSET_FILL);
      }
      if (state.edges) {
        shape.sides = shape.sides || this.indices(sidesOfFaces(decoded(item.faces)));
        this.drawSides(shape, state.faces ? [0, 0, 0] : item.color, state.faces ? 0.35 : 1);
      }
    }
  }

  drawSides(shape, color, opacity) {
    const gl = this.gl, u = this.uniforms;
    gl.uniform1i(u.kind, 2);
    gl.uniform4f(u.plain, ...color, opacity);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, shape.sides.buffer);
    gl.drawElements(gl.LINES, shape.sides.count, shape.sides.type, 0);
    gl.disable(gl.BLEND);
  }

  // Lines that change seldom, made anew when `key` differs.
  drawLines(name, key, make, color, opacity) {
    const gl = this.gl, u = this.uniforms;
    const old = this.lines[name];
    if (!old || old.key !== key) {
      const points = make();
      if (old) gl.deleteBuffer(old.buffer);
      const array = old ? old.array : gl.createVertexArray();
      gl.bindVertexArray(array);
      this.attribute(POSITION, points, 3, false);
      this.lines[name] = { key: key, array: array, count: points.length / 3, buffer: gl.getParameter(gl.ARRAY_BUFFER_BINDING) };
    }
    const lines = this.lines[name];
    gl.bindVertexArray(lines.array);
    gl.uniform1i(u.kind, 2);
    gl.uniform4f(u.plain, ...color, opacity);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.LINES, 0, lines.count);
    gl.disable(gl.BLEND);
  }

  drawGrid(state) {
    const dark = state.background === "dark" || state.background === "grey";
    this.gl.uniform3f(this.uniforms.offset, 0, 0, 0);
    const key = [state.up, this.scene.version].join();
    this.drawLines("grid", key, () => this.scene.grid(state.up), dark ? [1, 1, 1] : [0, 0, 0], dark ? 0.2 : 0.14);
  }

  // Three short lines in the lower left corner: red x, green y, blue z.
  drawAxes(view, width, height) {
    const gl = this.gl, u = this.uniforms, axes = view.axes();
    const side = Math.round(AXES_SIDE * this.scene.ratio);
    gl.viewport(0, 0, side, side);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    const flat = new Float32Array(16);
    const turned = rigid(axes.right, axes.up, axes.back, [0, 0, 0]);
    flat[0] = flat[5] = 0.7;
    flat[10] = -0.5;
    flat[15] = 1;
    gl.uniformMatrix4fv(u.toClip, false, product(flat, turned));
    gl.uniform3f(u.offset, 0, 0, 0);
    for (const axis of [0, 1, 2]) {
      const end = [0, 1, 2].map((other) => (other === axis ? 1 : 0));
      this.drawLines("axis" + axis, "", () => new Float32Array([0, 0, 0, ...end]), AXIS_COLORS[axis], 1);
    }
    gl.viewport(0, 0, width, height);
  }

  // The depth from 0 to 1 of what is seen at a pixel or near it; null for nothing.
  depthAt(view, state, column, row) {
    const gl = this.gl;
    const target = this.depthTarget();
    const reach = Math.floor(PICK_WINDOW / 2);
    const [left, bottom] = [column - reach, row - reach];
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, bottom, PICK_WINDOW, PICK_WINDOW);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.begin(view, state);
    gl.uniform1i(this.uniforms.depthOnly, 1);
    for (const shape of this.shapes) {
      if (shape.item.visible && shape.item.kind !== "lines") this.drawShape(shape, { ...state, faces: true, edges: false });
    }
    const pixels = new Uint8Array(4 * PICK_WINDOW * PICK_WINDOW);
    gl.readPixels(left, bottom, PICK_WINDOW, PICK_WINDOW, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.bindVertexArray(null);
    return nearestDepth(pixels);
  }

  // A frame buffer of the window's size, made anew when that changes.
  depthTarget() {
    const gl = this.gl, [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    if (this.target && this.target.width === width && this.target.height === height) return this.target.frame;
    if (this.target) this.target.free();
    const frame = gl.createFramebuffer(), color = gl.createRenderbuffer(), depth = gl.createRenderbuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.bindRenderbuffer(gl.RENDERBUFFER, color);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, color);
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    const free = () => {
      gl.deleteFramebuffer(frame);
      gl.deleteRenderbuffer(color);
      gl.deleteRenderbuffer(depth);
    };
    this.target = { width: width, height: height, frame: frame, free: free };
    return frame;
  }
}

// The depth nearest to the middle of a window of packed depths; all ones are nothing.
function nearestDepth(pixels) {
  const middle = Math.floor(PICK_WINDOW / 2);
  let best = null, closest = Infinity;
  for (let i = 0; i < PICK_WINDOW * PICK_WINDOW; i++) {
    const [a, b, c, d] = pixels.subarray(4 * i, 4 * i + 4);
    if (a === 255 && b === 255 && c === 255 && d === 255) continue;
    const away = Math.hypot(i % PICK_WINDOW - middle, Math.floor(i / PICK_WINDOW) - middle);
    if (away < closest) {
      closest = away;
      best = (a + b / 255 + c / 65025 + d / 16581375) / 255;
    }
  }
  return best;
}
