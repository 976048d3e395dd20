#version 450
// Derived from the shader pack "minimal" of SAPIEN 3 (Copyright 2025 Hillbot Inc., 2020-2024 UCSD SU Lab; Apache License 2.0,
// see NOTICE); changed for manifeel_ms3.
layout (location = 0) out vec2 outUV;

void main() {
  outUV = vec2((gl_VertexIndex << 1) & 2, gl_VertexIndex & 2);
  gl_Position = vec4(outUV * 2 - 1, 0, 1);
}
