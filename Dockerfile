# vdb-edit without a toolchain:
#   docker build -t vdb-edit .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" vdb-edit info surface.vdb
# Both stages are Debian bookworm, so that the libraries that were linked are the ones that are there.

FROM rust:1-bookworm AS build
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends \
        libopenvdb-dev libboost-dev libtbb-dev libimath-dev \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY . .
RUN cargo build --release --locked --bin vdb-edit \
    && strip --strip-debug target/release/vdb-edit

FROM debian:bookworm-slim
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends \
        libopenvdb10.0 libtbb12 libimath-3-1-29 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /src/target/release/vdb-edit /usr/local/bin/vdb-edit
COPY LICENSE-MIT LICENSE-APACHE /usr/share/doc/vdb-edit/
# Fails the build of the image, not its first use, if a library is missing.
RUN vdb-edit --version
WORKDIR /data
ENTRYPOINT ["vdb-edit"]
