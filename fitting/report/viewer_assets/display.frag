// From radiance to what a screen shows.
#ifndef PROBE
uniform bool srgb, marked;
uniform float exposure;
out vec4 colour;

float largest(vec3 difference) {
    vec3 size_of = abs(difference);
    float most = max(size_of.r, max(size_of.g, size_of.b));
    return most == size_of.r ? difference.r : most == size_of.g ? difference.g : difference.b;
}

vec3 ramp(float share) {  // from -1, blue, by grey to 1, yellow
    share = clamp(share, -1.0, 1.0);
    vec3 end = share < 0.0 ? vec3(0.0, 0.13, 0.31) : vec3(1.0, 0.92, 0.27);
    return mix(vec3(0.48, 0.48, 0.47), end, abs(share));
}

vec3 display(vec3 value, vec2 place) {
    value *= exposure;
    bool clipped = marked && any(greaterThan(value, vec3(1.0)));
    value = clamp(value, 0.0, 1.0);
    if (srgb) value = mix(1.055 * pow(value, vec3(1.0 / 2.4)) - 0.055, 12.92 * value, lessThan(value, vec3(0.0031308)));
    bool stripe = mod(floor((place.x + place.y) / 3.0), 2.0) < 1.0;
    return clipped && stripe ? vec3(1.0, 0.0, 0.6) : value;
}

vec4 rounded(vec3 value) {  // not every driver rounds to the nearest of the 256 codes
    return vec4(floor(value * 255.0 + 0.5) / 255.0, 1.0);
}
#endif

