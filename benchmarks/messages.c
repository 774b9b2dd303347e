/* What this process sends by MPI, counted: a library that is loaded before MPI's own (LD_PRELOAD) and passes all on.

   Messages are those to other ranks, one for each receiver also in operations between neighbours. Collectives are
   those of communicators with more than one rank. Bytes are those that this rank hands over. */
#include <mpi.h>
#include <stdlib.h>

enum { MESSAGE, ALLREDUCE, BROADCAST, GATHER, OTHER, KINDS };

static double counts[2 * KINDS]; /* number and bytes of each kind */

void messages_read(double *result) {
  for (int i = 0; i < 2 * KINDS; ++i)
    result[i] = counts[i];
}

static void note(int kind, double number, double bytes) {
  counts[2 * kind] += number;
  counts[2 * kind + 1] += bytes;
}

static double bytes_of(int count, MPI_Datatype type) {
  int size;
  PMPI_Type_size(type, &size);
  return (double)size * count;
}

static int ranks(MPI_Comm comm) {
  int size;
  PMPI_Comm_size(comm, &size);
  return size;
}

static void together(int kind, int count, MPI_Datatype type, MPI_Comm comm) {
  if (ranks(comm) > 1)
    note(kind, 1, bytes_of(count, type));
}

static void message(int count, MPI_Datatype type, int to, MPI_Comm comm) {
  int me;
  PMPI_Comm_rank(comm, &me);
  if (to != MPI_PROC_NULL && to != me)
    note(MESSAGE, 1, bytes_of(count, type));
}

/* -- messages */

#define SEND(NAME, ...)                                                                                               \
  message(count, type, to, comm);                                                                                     \
  return P##NAME(data, count, type, to, tag, comm, ##__VA_ARGS__)

#define TO const void *data, int count, MPI_Datatype type, int to, int tag, MPI_Comm comm

int MPI_Send(TO) { SEND(MPI_Send); }
int MPI_Ssend(TO) { SEND(MPI_Ssend); }
int MPI_Rsend(TO) { SEND(MPI_Rsend); }
int MPI_Bsend(TO) { SEND(MPI_Bsend); }
int MPI_Isend(TO, MPI_Request *request) { SEND(MPI_Isend, request); }
int MPI_Issend(TO, MPI_Request *request) { SEND(MPI_Issend, request); }
int MPI_Irsend(TO, MPI_Request *request) { SEND(MPI_Irsend, request); }

int MPI_Sendrecv(const void *data, int count, MPI_Datatype type, int to, int tag, void *into, int room,
                 MPI_Datatype kind, int from, int tag_from, MPI_Comm comm, MPI_Status *status) {
  message(count, type, to, comm);
  return PMPI_Sendrecv(data, count, type, to, tag, into, room, kind, from, tag_from, comm, status);
}

/* Messages that are prepared once and sent often, as PETSc's are: requests and their bytes. */
static struct { MPI_Request request; double bytes; } *prepared;
static int known, room;

static void prepare(MPI_Request request, int count, MPI_Datatype type, int to, MPI_Comm comm) {
  int me;
  PMPI_Comm_rank(comm, &me);
  if (to == MPI_PROC_NULL || to == me)
    return;
  if (known == room)
    prepared = realloc(prepared, (room = 2 * room + 64) * sizeof *prepared);
  prepared[known].request = request;
  prepared[known++].bytes = bytes_of(count, type);
}

static void start(MPI_Request request) {
  for (int k = known - 1; k >= 0; --k)
    if (prepared[k].request == request) {
      note(MESSAGE, 1, prepared[k].bytes);
      return;
    }
}

#define PREPARE(NAME)                                                                                                 \
  int error = P##NAME(data, count, type, to, tag, comm, request);                                                     \
  prepare(*request, count, type, to, comm);                                                                           \
  return error

int MPI_Send_init(TO, MPI_Request *request) { PREPARE(MPI_Send_init); }
int MPI_Ssend_init(TO, MPI_Request *request) { PREPARE(MPI_Ssend_init); }
int MPI_Rsend_init(TO, MPI_Request *request) { PREPARE(MPI_Rsend_init); }

int MPI_Start(MPI_Request *request) {
  start(*request);
  return PMPI_Start(request);
}

int MPI_Startall(int n, MPI_Request requests[]) {
  for (int i = 0; i < n; ++i)
    start(requests[i]);
  return PMPI_Startall(n, requests);
}

int MPI_Request_free(MPI_Request *request) {
  for (int k = known - 1; k >= 0; --k)
    if (prepared[k].request == *request) {
      prepared[k] = prepared[--known];
      break;
    }
  return PMPI_Request_free(request);
}

/* -- between neighbours */

static void neighbours(const int sizes[], int same, MPI_Datatype type, MPI_Comm comm) {
  int from, to, weighted;
  if (PMPI_Dist_graph_neighbors_count(comm, &from, &to, &weighted) != MPI_SUCCESS)
    return;
  for (int i = 0; i < to; ++i)
    if (sizes == NULL || sizes[i] > 0)
      note(MESSAGE, 1, bytes_of(sizes == NULL ? same : sizes[i], type));
}

#define VECTORS                                                                                                       \
  const void *data, const int sizes[], const int starts[], MPI_Datatype type, void *into, const int sizes_into[],     \
      const int starts_into[], MPI_Datatype type_into, MPI_Comm comm
#define PARTS const void *data, int count, MPI_Datatype type, void *into, int count_into, MPI_Datatype type_into
#define ONES PARTS, MPI_Comm comm

int MPI_Neighbor_alltoallv(VECTORS) {
  neighbours(sizes, 0, type, comm);
  return PMPI_Neighbor_alltoallv(data, sizes, starts, type, into, sizes_into, starts_into, type_into, comm);
}
int MPI_Ineighbor_alltoallv(VECTORS, MPI_Request *request) {
  neighbours(sizes, 0, type, comm);
  return PMPI_Ineighbor_alltoallv(data, sizes, starts, type, into, sizes_into, starts_into, type_into, comm, request);
}
int MPI_Neighbor_alltoall(ONES) {
  neighbours(NULL, count, type, comm);
  return PMPI_Neighbor_alltoall(data, count, type, into, count_into, type_into, comm);
}
int MPI_Neighbor_allgather(ONES) {
  neighbours(NULL, count, type, comm);
  return PMPI_Neighbor_allgather(data, count, type, into, count_into, type_into, comm);
}

/* -- collectives */

#define REDUCED const void *data, void *into, int count, MPI_Datatype type, MPI_Op op

int MPI_Allreduce(REDUCED, MPI_Comm comm) {
  together(ALLREDUCE, count, type, comm);
  return PMPI_Allreduce(data, into, count, type, op, comm);
}
int MPI_Iallreduce(REDUCED, MPI_Comm comm, MPI_Request *request) {
  together(ALLREDUCE, count, type, comm);
  return PMPI_Iallreduce(data, into, count, type, op, comm, request);
}
int MPI_Reduce(REDUCED, int root, MPI_Comm comm) {
  together(OTHER, count, type, comm);
  return PMPI_Reduce(data, into, count, type, op, root, comm);
}
int MPI_Scan(REDUCED, MPI_Comm comm) {
  together(OTHER, count, type, comm);
  return PMPI_Scan(data, into, count, type, op, comm);
}
int MPI_Exscan(REDUCED, MPI_Comm comm) {
  together(OTHER, count, type, comm);
  return PMPI_Exscan(data, into, count, type, op, comm);
}
int MPI_Reduce_scatter_block(REDUCED, MPI_Comm comm) {
  together(OTHER, count, type, comm);
  return PMPI_Reduce_scatter_block(data, into, count, type, op, comm);
}
int MPI_Bcast(void *data, int count, MPI_Datatype type, int root, MPI_Comm comm) {
  together(BROADCAST, count, type, comm);
  return PMPI_Bcast(data, count, type, root, comm);
}
int MPI_Barrier(MPI_Comm comm) {
  together(OTHER, 0, MPI_BYTE, comm);
  return PMPI_Barrier(comm);
}
int MPI_Ibarrier(MPI_Comm comm, MPI_Request *request) {
  together(OTHER, 0, MPI_BYTE, comm);
  return PMPI_Ibarrier(comm, request);
}
int MPI_Allgather(ONES) {
  together(GATHER, count, type, comm);
  return PMPI_Allgather(data, count, type, into, count_into, type_into, comm);
}
int MPI_Allgatherv(const void *data, int count, MPI_Datatype type, void *into, const int sizes[], const int starts[],
                   MPI_Datatype type_into, MPI_Comm comm) {
  together(GATHER, count, type, comm);
  return PMPI_Allgatherv(data, count, type, into, sizes, starts, type_into, comm);
}
int MPI_Gather(PARTS, int root, MPI_Comm comm) {
  together(GATHER, count, type, comm);
  return PMPI_Gather(data, count, type, into, count_into, type_into, root, comm);
}
int MPI_Gatherv(const void *data, int count, MPI_Datatype type, void *into, const int sizes[], const int starts[],
                MPI_Datatype type_into, int root, MPI_Comm comm) {
  together(GATHER, count, type, comm);
  return PMPI_Gatherv(data, count, type, into, sizes, starts, type_into, root, comm);
}
int MPI_Alltoall(ONES) {
  together(OTHER, count * ranks(comm), type, comm);
  return PMPI_Alltoall(data, count, type, into, count_into, type_into, comm);
}
int MPI_Alltoallv(VECTORS) {
  int all = 0;
  for (int i = 0; i < ranks(comm); ++i)
    all += sizes[i];
  together(OTHER, all, type, comm);
  return PMPI_Alltoallv(data, sizes, starts, type, into, sizes_into, starts_into, type_into, comm);
}
int MPI_Reduce_scatter(const void *data, void *into, const int sizes[], MPI_Datatype type, MPI_Op op, MPI_Comm comm) {
  int all = 0;
  for (int i = 0; i < ranks(comm); ++i)
    all += sizes[i];
  together(OTHER, all, type, comm);
  return PMPI_Reduce_scatter(data, into, sizes, type, op, comm);
}
int MPI_Scatter(PARTS, int root, MPI_Comm comm) {
  together(OTHER, count, type, comm);
  return PMPI_Scatter(data, count, type, into, count_into, type_into, root, comm);
}
