"""The separable fit: sums over pixels, and the global optimum from them."""
