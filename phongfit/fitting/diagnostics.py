"""When a highlight counts as seen."""

# A highlight counts as seen from so many standard errors on. Its exponent is the one
# that fits best: chance reaches further than 3.
SEEN = 4.0
