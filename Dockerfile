# gsdmsr on a CPU.
#
#   docker build --tag gsdmsr --build-arg COMMIT="$(git describe --always --dirty)" .
#   docker run --rm --volume "$PWD:/work" --volume gsdmsr-cache:/home/gsdmsr/.cache gsdmsr demo
#
# The volume of the cache keeps the compiled kernels; without it every container compiles its own.
FROM python:3.12-slim

RUN useradd --create-home gsdmsr \
    && install --directory --owner gsdmsr /work /home/gsdmsr/.cache

# torch's CPU build first: pip would take the one with CUDA, some gigabytes larger
ARG TORCH=2.13.0
RUN pip install --no-cache-dir torch==${TORCH} --index-url https://download.pytorch.org/whl/cpu

COPY . /source
ARG COMMIT=unknown
RUN echo "${COMMIT}" > /source/gsdmsr_cli/built_from.txt \
    && pip install --no-cache-dir /source \
    && rm -r /source

USER gsdmsr
WORKDIR /work
ENTRYPOINT ["gsdmsr"]
CMD ["--help"]
