#version 450
// Derived from the shader pack "minimal" of SAPIEN 3 (Copyright 2025 Hillbot Inc., 2020-2024 UCSD SU Lab; Apache License 2.0,
// see NOTICE); changed for manifeel_ms3.
// One vertex. Positions for depth are computed exactly as in the original; what lighting needs is in the world's frame.
layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

// SAPIEN lays out every mesh with these five
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;

layout(location = 0) out vec4 outPosition;
layout(location = 1) out vec2 outUV;
layout(location = 2) out flat uint outSegmentation;
layout(location = 3) out vec3 outNormal;
layout(location = 4) out vec3 outWorldPosition;

void main() {
  outSegmentation = objectDataBuffer.segmentation.y;
  mat4 modelView = cameraBuffer.viewMatrix * objectTransformBuffer.modelMatrix;
  outPosition = modelView * vec4(position, 1);
  outUV = uv;
  gl_Position = cameraBuffer.projectionMatrix * outPosition;
  // the cofactors of a matrix turn normals as its inverse transpose does, at a fraction of the cost
  mat3 m = mat3(objectTransformBuffer.modelMatrix);
  outNormal = normal.x * cross(m[1], m[2]) + normal.y * cross(m[2], m[0]) + normal.z * cross(m[0], m[1]);
  outWorldPosition = (objectTransformBuffer.modelMatrix * vec4(position, 1)).xyz;
}
