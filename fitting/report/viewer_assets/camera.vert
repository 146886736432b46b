// Triangles of a mesh, or one triangle over the whole canvas where every pixel finds its own hit.
uniform vec2 size, middle;
uniform float pitch, depth_of_pivot;
uniform bool perspective;
uniform vec3 axis_point, right, up, forward;
#ifdef MESH
in vec3 corner, corner_a, corner_b, corner_c, normal_a, normal_b, normal_c;
flat out vec3 a, b, c, of_a, of_b, of_c;  // the triangle whole: what lies between is found per pixel, exactly

void main() {
    a = corner_a, b = corner_b, c = corner_c;
    of_a = normal_a, of_b = normal_b, of_c = normal_c;
    vec3 offset = corner - axis_point;
    float w = perspective ? dot(offset, forward) + depth_of_pivot : 1.0;
    vec2 reach = 0.5 * pitch * size;
    gl_Position = vec4((vec2(dot(offset, right), dot(offset, up)) - middle * w) / reach, 0.0, w);
}
#else
void main() {
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}
#endif
