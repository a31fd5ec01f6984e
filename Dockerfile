# The programs with weights and samples: docker build -t sixfold . && docker run --rm -v "$PWD:/data" sixfold demo --out /data/out
FROM rust:1.95-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY . /sixfold
WORKDIR /sixfold
RUN cargo build --release --locked -p sixfold-cli --features serve && cargo build --release --locked -p sixfold-experiments && \
    strip target/release/sixfold target/release/sixfold-experiments

FROM debian:bookworm-slim
COPY --from=build /sixfold/target/release/sixfold /sixfold/target/release/sixfold-experiments /usr/local/bin/
COPY weights /usr/local/share/sixfold/weights
COPY data/demo /usr/local/share/sixfold/demo
COPY LICENSE-MIT LICENSE-APACHE /usr/local/share/doc/sixfold/
WORKDIR /data
ENTRYPOINT ["sixfold"]
