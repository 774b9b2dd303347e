/* Triangles in a tree of boxes: the places of them that are nearest to points, and the lines that pass through them.

   Node i of the tree has the nodes 2 i + 1 and 2 i + 2 below it, and the last "leaves" nodes have a few triangles each.
   The regions of nearest places are those of C. Ericson, Real-Time Collision Detection, section 5.1.5. */
#include <math.h>
#include <stdint.h>

#define DEPTH 64
#define ROUNDED 1e-12 /* part of a distance that rounding may lack: no triangle that counts is lost */

enum { FACE = 0, EDGE = 1, CORNER = 4 };

typedef struct {
  const double *x;      /* their corners, those of the leaves one after the other, (triangles, 3, 3) */
  const int64_t *order; /* their numbers in this order, (triangles) */
  int64_t leaves;       /* a power of two */
  const int64_t *first; /* triangle of each leaf, and their number, (leaves + 1) */
  double *boxes;        /* least and largest coordinates, (2 leaves - 1, 2, 3) */
  double *discs;        /* around the triangles of a leaf: middle, unit normal, thickness, radius, (leaves, 8) */
} tree;

typedef struct {
  int64_t room;               /* for so many places */
  int64_t *point, *triangle;  /* (room) */
  int64_t *kind;              /* (room) */
  double *inner;              /* second and third barycentric coordinates, (room, 2) */
  double *gap;                /* from there to the point, (room, 3) */
  double *distance;           /* (room) */
} places;

typedef struct {
  double share, size; /* of the distance and a size more, which rounding may make */
} tolerance;

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* One instruction each, where fmin and fmax are calls. */
static double smaller(double a, double b) { return a < b ? a : b; }

static double larger(double a, double b) { return a > b ? a : b; }

static void minus(const double *a, const double *b, double *result) {
  for (int i = 0; i < 3; ++i)
    result[i] = a[i] - b[i];
}

static void cross(const double *a, const double *b, double *result) {
  result[0] = a[1] * b[2] - a[2] * b[1];
  result[1] = a[2] * b[0] - a[0] * b[2];
  result[2] = a[0] * b[1] - a[1] * b[0];
}

static double part(double value, double whole) { return whole != 0.0 ? value / whole : 0.0; }

/* Farthest that counts as equally near as the nearest. */
static double same(double least, const tolerance *t) { return least + t->share * (least + t->size); }

static void fit_disc(const tree *t, int64_t leaf) {
  double *middle = t->discs + 8 * leaf, *normal = middle + 3, *thickness = middle + 6, *radius = middle + 7;
  const double *box = t->boxes + 6 * (leaf + t->leaves - 1);
  double b[3], c[3], across[3];
  for (int i = 0; i < 3; ++i) {
    middle[i] = 0.5 * (box[i] + box[3 + i]);
    normal[i] = 0.0;
  }
  *thickness = *radius = 0.0;
  for (int64_t k = t->first[leaf]; k < t->first[leaf + 1]; ++k) {
    minus(t->x + 9 * k + 3, t->x + 9 * k, b);
    minus(t->x + 9 * k + 6, t->x + 9 * k, c);
    cross(b, c, across);
    for (int i = 0; i < 3; ++i)
      normal[i] += across[i];
  }
  const double length = sqrt(dot(normal, normal));
  for (int i = 0; i < 3; ++i)
    normal[i] = part(normal[i], length);
  for (int64_t k = 3 * t->first[leaf]; k < 3 * t->first[leaf + 1]; ++k) {
    minus(t->x + 3 * k, middle, b);
    *thickness = larger(*thickness, fabs(dot(b, normal)));
    *radius = larger(*radius, sqrt(dot(b, b)));
  }
  *thickness += ROUNDED * *radius;
}

/* Boxes around what is below each node, and discs; boxes of nothing are as far away as can be. */
void fit(const tree *t) {
  for (int64_t node = 2 * t->leaves - 2; node >= 0; --node) {
    double *low = t->boxes + 6 * node, *high = low + 3;
    const int64_t leaf = node - t->leaves + 1;
    for (int i = 0; i < 3; ++i) {
      low[i] = INFINITY;
      high[i] = -INFINITY;
      for (int64_t k = leaf < 0 ? 0 : t->first[leaf]; leaf >= 0 && k < t->first[leaf + 1]; ++k)
        for (int corner = 0; corner < 3; ++corner) {
          const double value = t->x[9 * k + 3 * corner + i];
          low[i] = smaller(low[i], value);
          high[i] = larger(high[i], value);
        }
      for (int64_t child = 2 * node + 1; leaf < 0 && child < 2 * node + 3; ++child) {
        low[i] = smaller(low[i], t->boxes[6 * child + i]);
        high[i] = larger(high[i], t->boxes[6 * child + 3 + i]);
      }
    }
    if (leaf >= 0)
      fit_disc(t, leaf);
  }
}

/* Length of the diagonal of the largest of the boxes of leaves, of which some may be around nothing. */
double largest(const tree *t) {
  double most = 0.0;
  for (int64_t node = t->leaves - 1; node < 2 * t->leaves - 1; ++node) {
    const double *low = t->boxes + 6 * node;
    double way[3];
    minus(low + 3, low, way);
    if (way[0] >= 0.0)
      most = larger(most, dot(way, way));
  }
  return sqrt(most);
}

static double from_box(const double *box, const double *at) {
  double result = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double way = larger(larger(box[i] - at[i], at[i] - box[3 + i]), 0.0); /* no branch: it would be a guess */
    result += way * way;
  }
  return result;
}

/* Square of what a point is at least away from a disc. */
static double from_disc(const double *disc, const double *at) {
  double off[3];
  minus(at, disc, off);
  const double height = fabs(dot(off, disc + 3)), above = height - disc[6];
  const double aside = sqrt(larger(dot(off, off) - height * height, 0.0)) - disc[7];
  return larger(above, 0.0) * larger(above, 0.0) + larger(aside, 0.0) * larger(aside, 0.0);
}

/* Nearest place of one triangle: its kind, and as in places. */
static int64_t on_triangle(const double *x, const double *at, double *inner, double *gap, double *distance) {
  double b[3], c[3], arm[3];
  minus(x + 3, x, b);
  minus(x + 6, x, c);
  minus(at, x, arm);
  const double bb = dot(b, b), bc = dot(b, c), cc = dot(c, c), p = dot(arm, b), q = dot(arm, c);
  const double p_b = p - bb, q_b = q - bc, p_c = p - bc, q_c = q - cc; /* from the second and the third corner */
  const double at_a = p_b * q_c - p_c * q_b, at_b = p_c * q - p * q_c, at_c = p * q_b - p_b * q;
  const double up = q_b - p_b, down = p_c - q_c;
  int64_t kind = FACE;
  double second = 0.0, third = 0.0;
  if (p <= 0.0 && q <= 0.0)
    kind = CORNER;
  else if (p_b >= 0.0 && up <= 0.0) {
    kind = CORNER + 1;
    second = 1.0;
  } else if (q_c >= 0.0 && down <= 0.0) {
    kind = CORNER + 2;
    third = 1.0;
  } else if (at_c <= 0.0 && p >= 0.0 && p_b <= 0.0) {
    kind = EDGE + 2;
    second = part(p, bb);
  } else if (at_b <= 0.0 && q >= 0.0 && q_c <= 0.0) {
    kind = EDGE + 1;
    third = part(q, cc);
  } else if (at_a <= 0.0 && up >= 0.0 && down >= 0.0) {
    kind = EDGE;
    second = part(down, up + down);
    third = part(up, up + down);
  } else {
    const double size = at_a + at_b + at_c;
    second = part(at_b, size);
    third = part(at_c, size);
  }
  inner[0] = second;
  inner[1] = third;
  for (int i = 0; i < 3; ++i)
    gap[i] = arm[i] - second * b[i] - third * c[i];
  *distance = sqrt(dot(gap, gap));
  return kind;
}

/* Places of a leaf that may be the nearest ones: the least distance, and the number of places by now, -1: no room. */
static int64_t in_leaf(const tree *t, int64_t leaf, const double *at, const tolerance *tol, double limit,
                       double *least, int64_t first, int64_t found, const places *p) {
  for (int64_t k = t->first[leaf]; k < t->first[leaf + 1]; ++k) {
    double inner[2], gap[3], distance;
    const int64_t kind = on_triangle(t->x + 9 * k, at, inner, gap, &distance);
    if (!(distance <= limit && distance <= same(*least, tol)))
      continue;
    if (same(distance, tol) < *least)
      found = first;
    if (distance < *least)
      *least = distance;
    if (found == p->room)
      return -1;
    p->triangle[found] = k;
    p->kind[found] = kind;
    p->distance[found] = distance;
    for (int i = 0; i < 2; ++i)
      p->inner[2 * found + i] = inner[i];
    for (int i = 0; i < 3; ++i)
      p->gap[3 * found + i] = gap[i];
    ++found;
  }
  return found;
}

/* Square of what bounds the search for a place, with a little more for rounding. */
static double bounding(double distance) { return distance * distance * (1.0 + ROUNDED); }

/* Number of the places by then, -1: no room; a triangle, in the tree's order, may be known that is not far. */
static int64_t of_point(const tree *t, const double *at, double limit, const tolerance *tol, int64_t known,
                        int64_t first, const places *p) {
  int64_t stack[DEPTH], found = first;
  double far[DEPTH], inner[2], gap[3], least, bound = bounding(limit);
  on_triangle(t->x + 9 * known, at, inner, gap, &least);
  bound = smaller(bound, bounding(same(least, tol)));
  least = INFINITY;
  int height = 1;
  stack[0] = 0;
  far[0] = from_box(t->boxes, at);
  while (height > 0) {
    int64_t node = stack[--height];
    double way = far[height];
    while (way <= bound && node < t->leaves - 1) {
      int64_t child = 2 * node + 1;
      const double left = from_box(t->boxes + 6 * child, at), right = from_box(t->boxes + 6 * child + 6, at);
      node = left <= right ? child : child + 1;
      way = left <= right ? left : right;
      stack[height] = left <= right ? child + 1 : child;
      far[height++] = left <= right ? right : left;
    }
    if (way > bound || from_disc(t->discs + 8 * (node - t->leaves + 1), at) > bound)
      continue;
    found = in_leaf(t, node - t->leaves + 1, at, tol, limit, &least, first, found, p);
    if (found < 0)
      return -1;
    bound = smaller(bound, bounding(same(least, tol)));
  }
  return found;
}

/* Nearest places within a limit of each point, and those that are farther by rounding alone: their number, points
   ascending; -1: there is no room for them. */
int64_t nearest(const tree *t, int64_t points, const double *at, const double *limit, const tolerance *tol,
                places *p) {
  int64_t found = 0, known = 0;
  for (int64_t i = 0; i < points; ++i) {
    if (!(limit[i] >= 0.0))
      continue;
    const int64_t first = found, last = of_point(t, at + 3 * i, limit[i], tol, known, first, p);
    if (last < 0)
      return -1;
    double least = INFINITY;
    for (int64_t k = first; k < last; ++k)
      least = smaller(least, p->distance[k]);
    for (int64_t k = first; k < last; ++k) {
      if (p->distance[k] > same(least, tol))
        continue;
      known = p->triangle[k];
      p->point[found] = i;
      p->triangle[found] = t->order[known];
      p->kind[found] = p->kind[k];
      p->distance[found] = p->distance[k];
      for (int j = 0; j < 2; ++j)
        p->inner[2 * found + j] = p->inner[2 * k + j];
      for (int j = 0; j < 3; ++j)
        p->gap[3 * found + j] = p->gap[3 * k + j];
      ++found;
    }
  }
  return found;
}

/* A triangle, in the tree's order, within a limit of a point, -1: there is none; one may be known that is not far. */
static int64_t one_within(const tree *t, const double *at, double limit, int64_t known) {
  int64_t stack[DEPTH];
  double inner[2], gap[3], distance;
  const double bound = bounding(limit);
  on_triangle(t->x + 9 * known, at, inner, gap, &distance);
  if (distance <= limit)
    return known;
  int height = 1;
  stack[0] = 0;
  while (height > 0) {
    const int64_t node = stack[--height], leaf = node - t->leaves + 1;
    if (from_box(t->boxes + 6 * node, at) > bound)
      continue;
    if (leaf < 0) {
      stack[height++] = 2 * node + 2;
      stack[height++] = 2 * node + 1;
      continue;
    }
    if (from_disc(t->discs + 8 * leaf, at) > bound)
      continue;
    for (int64_t k = t->first[leaf]; k < t->first[leaf + 1]; ++k) {
      on_triangle(t->x + 9 * k, at, inner, gap, &distance);
      if (distance <= limit)
        return k;
    }
  }
  return -1;
}

/* Whether there are triangles within a limit of each point. */
void within(const tree *t, int64_t points, const double *at, const double *limit, int8_t *result) {
  int64_t known = 0;
  for (int64_t i = 0; i < points; ++i) {
    const int64_t found = limit[i] >= 0.0 ? one_within(t, at + 3 * i, limit[i], known) : -1;
    result[i] = found >= 0;
    known = found >= 0 ? found : known;
  }
}

static int beside(const double *box, const double *start, const double *end) {
  if (box[0] > box[3])
    return 1; /* it has nothing */
  for (int i = 0; i < 3; ++i) {
    const double low = smaller(start[i], end[i]), high = larger(start[i], end[i]);
    const double slack = ROUNDED * (fabs(low) + fabs(high) + fabs(box[i]) + fabs(box[3 + i]));
    if (low > box[3 + i] + slack || high < box[i] - slack)
      return 1;
  }
  return 0;
}

static int passes(const double *x, const double *start, const double *end) {
  double b[3], c[3], normal[3], line[3], arm[3][3], across[3];
  minus(x + 3, x, b);
  minus(x + 6, x, c);
  cross(b, c, normal);
  minus(end, start, line);
  for (int i = 0; i < 3; ++i)
    minus(x + 3 * i, start, arm[i]);
  const double height = dot(arm[0], normal);
  if (height * (height - dot(line, normal)) > 0.0)
    return 0;
  int positive = 0, negative = 0;
  for (int i = 0; i < 3; ++i) {
    cross(arm[i], arm[(i + 1) % 3], across);
    const double around = dot(line, across);
    positive += around >= 0.0;
    negative += around <= 0.0;
  }
  return positive == 3 || negative == 3;
}

/* Straight lines and triangles through which they pass, in pairs: their number, lines ascending; -1: no room. */
int64_t pierced(const tree *t, int64_t lines, const double *start, const double *end, int64_t room, int64_t *line,
                int64_t *triangle) {
  int64_t found = 0, stack[DEPTH];
  for (int64_t i = 0; i < lines; ++i) {
    int height = 1;
    stack[0] = 0;
    while (height > 0) {
      const int64_t node = stack[--height], leaf = node - t->leaves + 1;
      if (beside(t->boxes + 6 * node, start + 3 * i, end + 3 * i))
        continue;
      if (leaf < 0) {
        stack[height++] = 2 * node + 2;
        stack[height++] = 2 * node + 1;
        continue;
      }
      for (int64_t k = t->first[leaf]; k < t->first[leaf + 1]; ++k)
        if (passes(t->x + 9 * k, start + 3 * i, end + 3 * i)) {
          if (found == room)
            return -1;
          line[found] = i;
          triangle[found++] = t->order[k];
        }
    }
  }
  return found;
}
